"""The archive over HTTP: what is given is what was sealed, and nothing else of the machine."""

from __future__ import annotations

import base64
import hashlib
import io
import zipfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import h5py
import httpx2
import numpy as np
import pytest
from support.archives import Clock, registered, run_jobs, work_again
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.planning.graph import Request


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with a measurement, its surface and its displacement, all at two states."""
    home = tmp_path_factory.mktemp("archive") / "home"
    bootstrap.initialise(home)
    clock, archive = Clock(), Archive(FolderStore(home / "archive"))
    with closing(Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}")) as catalogue:
        work_again(catalogue, clock)
        registered(catalogue, archive, clock)
        kinds = ("simulate", "reconstruct", "correlate", "strain", "merge")
        run_jobs(catalogue, archive, clock, [Request(kind) for kind in kinds])
    return home


@pytest.fixture(scope="module")
def web(home: Path) -> Iterator[httpx2.Client]:
    with serving(home) as url, httpx2.Client(base_url=f"{url}/api/v1", timeout=60.0) as client:
        yield client


def newest(web: httpx2.Client, query: str) -> dict[str, Any]:
    """Return the newest file that meets a query."""
    found: dict[str, Any] = web.get("/data/find", params={"query": query, "limit": 1}).json()["files"][0]
    return found


def refused(answer: httpx2.Response, status: int, words: str) -> None:
    assert (answer.status_code, words in answer.json()["error"]) == (status, True), answer.text


def test_files_are_found_page_by_page(web: httpx2.Client) -> None:
    asked = {"columns": "kind,load_N", "limit": 2}
    first = web.get("/data/find", params=asked).json()
    rest = web.get("/data/find", params=asked | {"after": first["next"], "limit": 1000}).json()
    assert first["columns"] == ["kind", "load_N"]
    assert len(first["files"]) == 2
    assert rest["next"] is None
    numbers = [one["id"] for one in first["files"] + rest["files"]]
    assert numbers == sorted(numbers, reverse=True)
    assert {one["values"]["kind"] for one in rest["files"]} >= {"measurement", "calibration"}
    refused(web.get("/data/find", params={"query": "strain where"}), 422, "character")
    refused(web.get("/data/find", params={"query": "where campaign = nobody"}), 404, "nobody")


def test_jobs_are_listed_page_by_page_to_the_first(web: httpx2.Client) -> None:
    every = [one["id"] for one in web.get("/jobs", params={"limit": 10_000}).json()]
    seen: list[str] = []
    while page := web.get("/jobs", params={"limit": 4} | ({"after": seen[-1]} if seen else {})).json():
        seen += [one["id"] for one in page]
    assert seen == every
    assert len(every) > 4
    refused(web.get("/jobs", params={"after": "none"}), 404, "there is no job 'none'")


def test_the_audit_is_listed_page_by_page_to_its_begin(web: httpx2.Client) -> None:
    for _ in range(2):
        assert web.post("/queues/pause", json={"names": ["cpu"]}).status_code == 200
        assert web.post("/queues/resume", json={"names": ["cpu"]}).status_code == 200
    every = [one["number"] for one in web.get("/audit", params={"limit": 10_000}).json()]
    seen: list[int] = []
    while page := web.get("/audit", params={"limit": 3} | ({"after": seen[-1]} if seen else {})).json():
        seen += [one["number"] for one in page]
    assert seen == every
    assert len(every) > 3
    refused(web.get("/audit", params={"after": 0}), 422, "greater than or equal to 1, not '0'")


def test_what_is_not_known_is_named_and_never_passed_over(web: httpx2.Client) -> None:
    refused(
        web.get("/data/states", params={"where": "load > 3 kN"}),
        422,
        "'where' is no parameter of /api/v1/data/states; it takes query",
    )
    refused(
        web.get("/jobs", params={"limit": 0}),
        422,
        "'limit': it should be greater than or equal to 1, not '0'",
    )
    refused(
        web.post("/jobs", json={"campain": "plate", "kinds": ["strain"]}), 422, "'campain' is not known here"
    )
    refused(web.post("/jobs", json={"kinds": ["strain"]}), 422, "'campaign' is missing")
    plate = {"campaign": "plate", "kinds": ["strain"]}
    for given, said in (
        ({"priority": None}, "'priority': it should be a whole number, not null;"),
        ({"priority": "high"}, "'priority': it should be a whole number, not \"high\";"),
        ({"priority": 101}, "'priority': it should be less than or equal to 100, not 101;"),
        ({"run": "x" * 1001}, "'run': it should have at most 1000 characters, not 1001;"),
        ({"run": "a\0b"}, "'run': it should have no character of code 0, not"),
    ):
        refused(web.post("/jobs", json=plate | given), 422, said)
    refused(web.post("/jobs", content="{bad"), 422, "application/json")
    for body in (b'{"campaign": "pl\xff"}', b"[" * 100_000):
        told = web.post("/jobs", content=body, headers={"Content-Type": "application/json"})
        refused(told, 400, "the body cannot be read as JSON: it should be text in UTF-8")
    for since in ("yesterday", "2026-01-01", "2026-01-01T00:00:00", "2026-01-01T00:00:00 02:00"):
        told = (
            f"it should be a time with its zone, such as 2026-05-04T10:00:00Z, not '{since}'; in an address"
        )
        refused(web.get("/audit", params={"since": since}), 422, told)
    secret = web.post("/session", json={"name": "anna", "password": 12345678901234})
    assert secret.status_code == 422
    assert "12345678901234" not in secret.text
    mistaken = web.post("/session", json={"name": ["correct horse"], "password": "anna"})
    assert mistaken.status_code == 422
    assert "horse" not in mistaken.text
    refused(web.get("/data/nothing/here/at/all"), 404, "there is no address /api/v1/data/nothing/here/at/all")
    refused(web.delete("/jobs"), 405, "/api/v1/jobs does not take DELETE")


def test_a_queue_is_paused_as_it_is_told_or_not_at_all(web: httpx2.Client) -> None:
    for address, given, said in (
        ("pause", {"names": ["cpu"], "reson": "the rig"}, "'reson' is not known here"),
        (
            "pause",
            {"names": ["cpu"], "reason": "x" * 1001},
            "'reason': it should have at most 1000 characters",
        ),
        ("resume", {"names": ["cpu"], "all": True}, "'all' is not known here"),
        ("priority", {"jobs": [], "campaign": "plate", "value": "5"}, "'value': it should be a whole number"),
        ("move", {"jobs": [], "to": "front", "where": "x"}, "'where' is not known here"),
    ):
        refused(web.post(f"/queues/{address}", json=given), 422, said)
    refused(web.post("/devices/release", json={"device": "C1", "rig": "x"}), 422, "'rig' is not known here")
    assert [one["paused_at"] for one in web.get("/queues").json()] == [None] * 3
    assert web.post("/queues/pause", json={"names": ["io"]}).is_success
    (paused,) = [one for one in web.get("/queues").json() if one["paused_at"]]
    assert paused["reason"] == f"paused by {web.get('/session').json()['name']}"
    assert web.post("/queues/resume", json={"names": ["io"]}).is_success


def test_a_query_is_kept_asked_and_forgotten(web: httpx2.Client) -> None:
    kept = web.post("/data/queries", json={"name": "all-strain", "text": "strain"})
    assert kept.json()["text"] == "strain"
    assert [one["name"] for one in web.get("/data/queries").json()] == ["all-strain"]
    assert {one["source"] for one in web.get("/data/queries/all-strain").json()["files"]} == {"strain"}
    assert web.delete("/data/queries/all-strain").is_success
    refused(web.get("/data/queries/all-strain"), 404, "all-strain")


def test_a_file_is_described_drawn_and_traced(web: httpx2.Client) -> None:
    file = newest(web, "strain")
    about = web.get(f"/data/{file['id']}").json()
    assert about["records"]["strain"]["strain"]["axes"] == ["component", "row", "column"]
    assert about["file"]["content_hash"] == file["content_hash"]
    picture = web.get(f"/data/{file['id']}/picture.png", params={"field": "strain", "component": "xx"})
    assert picture.content.startswith(b"\x89PNG")
    roots = web.get(f"/data/{file['id']}/tree").json()["inputs"]
    assert (
        "displacement" in {one["role"] for one in roots} | {one["file"]["source"] for one in roots} or roots
    )
    assert web.post(f"/data/{file['id']}/pin", json={"reason": "paper"}).is_success
    assert [one["reason"] for one in web.get("/data/pins").json()] == ["paper"]
    assert web.delete(f"/data/{file['id']}/pin").is_success
    refused(web.get("/data/999999"), 404, "there is no file")


def test_a_sealed_file_is_given_as_it_lies_there(web: httpx2.Client, home: Path) -> None:
    file = newest(web, "strain")
    where = f"/data/{file['id']}/file"
    whole = web.get(where)
    assert whole.content == (home / "archive" / file["path"]).read_bytes()
    digest = base64.b64encode(hashlib.sha256(whole.content).digest()).decode()
    assert whole.headers["Repr-Digest"] == f"sha-256=:{digest}:"
    assert whole.headers["Content-Disposition"].startswith("attachment")
    head = web.head(where)
    assert int(head.headers["Content-Length"]) == len(whole.content)
    tag = head.headers["ETag"]
    assert web.get(where, headers={"If-None-Match": tag}).status_code == 304
    with h5py.File(io.BytesIO(whole.content)) as opened:
        assert "strain" in opened["entry"]


@pytest.mark.parametrize(
    ("header", "part"),
    [
        ("bytes=0-99", slice(0, 100)),
        ("bytes=100-", slice(100, None)),
        ("bytes=-7", slice(-7, None)),
        ("bytes=10-99999999999", slice(10, None)),
    ],
)
def test_a_range_is_a_part_of_the_file(web: httpx2.Client, header: str, part: slice) -> None:
    where = f"/data/{newest(web, 'strain')['id']}/file"
    whole = web.get(where)
    found = web.get(where, headers={"Range": header})
    assert (found.status_code, found.content) == (206, whole.content[part])
    start, stop, _ = part.indices(len(whole.content))
    assert found.headers["Content-Range"] == f"bytes {start}-{stop - 1}/{len(whole.content)}"
    of_another = web.get(where, headers={"Range": header, "If-Range": '"another"'})
    assert (of_another.status_code, of_another.content) == (200, whole.content)
    of_this = web.get(where, headers={"Range": header, "If-Range": whole.headers["ETag"]})
    assert of_this.status_code == 206


@pytest.mark.parametrize("header", ["bytes=99999999999-", "bytes=-0"])
def test_a_range_beyond_the_file_is_refused(web: httpx2.Client, header: str) -> None:
    file = newest(web, "strain")
    found = web.get(f"/data/{file['id']}/file", headers={"Range": header})
    assert found.status_code == 416
    assert found.headers["Content-Range"] == f"bytes */{file['size_bytes']}"


@pytest.mark.parametrize("header", ["bytes=0-9,20-29", "lines=1-2", "bytes=-", "bytes=9-3"])
def test_what_is_no_single_range_gives_the_whole(web: httpx2.Client, header: str) -> None:
    file = newest(web, "strain")
    found = web.get(f"/data/{file['id']}/file", headers={"Range": header})
    assert (found.status_code, len(found.content)) == (200, file["size_bytes"])


def array(web: httpx2.Client, file: int, name: str, part: str) -> Any:
    found = web.get(f"/data/{file}/arrays/{name}", params={"slice": part})
    assert found.is_success, found.text
    return np.load(io.BytesIO(found.content), allow_pickle=False)


def test_a_part_of_an_array_is_read(web: httpx2.Client, home: Path) -> None:
    file = newest(web, "strain")
    with h5py.File(home / "archive" / file["path"]) as opened:
        whole = opened["entry/strain/strain"][...]
    number = file["id"]
    np.testing.assert_array_equal(array(web, number, "strain/strain", ""), whole)
    part = array(web, number, "strain/strain", "1,10:60,::4")
    np.testing.assert_array_equal(part, whole[1, 10:60, ::4])
    lines = web.get(
        f"/data/{number}/arrays/strain/strain", params={"slice": "0:2,30,40:43", "format": "csv"}
    ).text.splitlines()
    assert lines[0] == "component,row,column,strain [1]"
    assert len(lines) == 7
    assert lines[4].startswith("1,30,40,")
    frames = newest(web, "measurement")
    with h5py.File(home / "archive" / frames["path"]) as opened:
        stack = opened["entry/measurement/frames"][1:6:2, 5:9]
    np.testing.assert_array_equal(array(web, frames["id"], "measurement/frames", "1:6:2,5:9"), stack)


@pytest.mark.parametrize("part", ["0,0,0,0", "x", "::0", "9", "-1", "0:1e9", ",,," + "9" * 50])
def test_a_part_that_is_none_is_refused(web: httpx2.Client, part: str) -> None:
    file = newest(web, "strain")["id"]
    found = web.get(f"/data/{file}/arrays/strain/strain", params={"slice": part})
    assert found.status_code == 422, found.text


@pytest.mark.parametrize(
    "path",
    [
        "/data/{file}/arrays/strain/..%2F..%2Fprocess",
        "/data/{file}/arrays/..%2F..%2Fetc/passwd",
        "/data/{file}/zarr/../../../settings.toml",
        "/data/{file}/zarr/..%2F..%2Fsettings.toml",
        "/data/{file}/zarr/process/provenance/c",
        "/data/{file}/zarr/strain/strain/c/0/0/99",
        "/data/..%2F..%2Fsettings.toml/file",
        "/data/%2Fetc%2Fpasswd",
    ],
)
def test_nothing_leads_out_of_a_file_or_the_archive(web: httpx2.Client, path: str) -> None:
    answer = web.get(path.format(file=newest(web, "strain")["id"]))
    assert answer.status_code == 404


def test_no_file_of_the_server_is_compared_or_written(web: httpx2.Client, tmp_path: Path) -> None:
    merged = newest(web, "merge")["id"]
    assert web.get(f"/data/{merged}/compare", params={"with": "/etc/passwd"}).status_code == 422
    refused(
        web.get("/campaigns/plate/compare", params={"with": f"{tmp_path}/{{state}}.vtu"}), 422, "campaign"
    )


def test_displacements_and_sections_come_as_numbers_and_pictures(web: httpx2.Client) -> None:
    merged = newest(web, "merge")["id"]
    same = web.get(f"/data/{merged}/compare", params={"with": merged}).json()
    assert same["points"] > 100
    assert same["rms_mm"] == pytest.approx(0.0, abs=1e-6)
    line = {"x0": -20, "y0": 0, "x1": 20, "y1": 0, "field": "strain"}
    strain = newest(web, "strain")["id"]
    told = web.get(f"/data/{strain}/section", params=line).json()
    assert dict(zip(told["columns"], told["units"], strict=True)) == {
        "distance_mm": "mm", "X_mm": "mm", "Y_mm": "mm", "Z_mm": "mm",
        "strain_xx": "1", "strain_yy": "1", "strain_xy": "1", "pixels": "1",
    }  # fmt: skip
    heading = web.get(f"/data/{strain}/section", params=line | {"format": "csv"}).text.splitlines()[0]
    assert heading == "distance_mm,X_mm,Y_mm,Z_mm,strain_xx [1],strain_yy [1],strain_xy [1],pixels"
    beside = web.get(f"/data/{strain}/section", params=line | {"x0": -9000, "x1": -8000})
    assert beside.status_code == 422
    assert (
        "no pixel with a value lies along the section from -9000,0 to -8000,0; the field lies from"
        in (beside.json()["error"])
    )
    drawn = web.get(f"/data/{strain}/section", params=line | {"format": "png"})
    assert drawn.content.startswith(b"\x89PNG")


def test_a_result_is_exported(web: httpx2.Client) -> None:
    merged = newest(web, "merge")["id"]
    assert "ply" in {one["name"] for one in web.get("/formats").json()}
    made = web.get(f"/data/{merged}/export", params={"format": "ply"})
    content = made.content
    if "zip" in made.headers["Content-Disposition"]:
        with zipfile.ZipFile(io.BytesIO(content)) as packed:
            content = packed.read(packed.namelist()[0])
    assert content.startswith(b"ply\n")
    refused(web.get(f"/data/{merged}/export", params={"format": "nonsense"}), 422, "no export format")


@pytest.mark.parametrize("query", ["strain", "measurement", "merge", "calibration"])
def test_zarr_reads_what_the_archive_holds(web: httpx2.Client, home: Path, query: str) -> None:
    file = newest(web, query)
    from support.zarr_over_http import opened_group

    group, _ = opened_group(web, file["id"])
    about = web.get(f"/data/{file['id']}/arrays").json()["records"]
    assert {name for name, _ in group.groups()} == set(about)
    with h5py.File(home / "archive" / file["path"]) as opened:
        for record, arrays in about.items():
            for name in arrays:
                found = group[f"{record}/{name}"]
                np.testing.assert_array_equal(found[...], opened[f"entry/{record}/{name}"][...])
                assert found.attrs["units"] == arrays[name]["unit"]
                assert list(found.metadata.dimension_names) == arrays[name]["axes"]


@pytest.mark.parametrize("query", ["strain", "measurement", "merge"])
def test_zarr_that_is_packed_has_the_same_values_in_fewer_bytes(web: httpx2.Client, query: str) -> None:
    file = newest(web, query)["id"]
    from support.zarr_over_http import opened_group

    groups, (plain, packed) = zip(opened_group(web, file), opened_group(web, file, "zarr-gzip"), strict=True)
    for record, _ in groups[0].groups():
        for name, array_of in groups[0][record].arrays():
            other = groups[1][f"{record}/{name}"]
            assert [codec.to_dict()["name"] for codec in other.metadata.codecs] == ["bytes", "gzip"]
            np.testing.assert_array_equal(array_of[...], other[...])
    assert packed.received < 0.8 * plain.received  # measured: 0.51 to 0.69 of the chunks
    metadata = f"/data/{file}/zarr-gzip/zarr.json"
    assert web.get(metadata).content == web.get(metadata).content
    refused(web.get(f"/data/{file}/zarr-gzip/none/none/c/0"), 404, "there is nothing named")


def test_a_damaged_file_is_not_given_out(web: httpx2.Client, home: Path) -> None:
    file = newest(web, "reconstruct where state = S00")
    path = home / "archive" / file["path"]
    kept = path.read_bytes()
    path.chmod(0o644)
    try:
        middle = len(kept) // 2
        path.write_bytes(kept[:middle] + bytes([kept[middle] ^ 1]) + kept[middle + 1 :])
        # The last block is held back.
        with pytest.raises(httpx2.RemoteProtocolError, match="1048576 bytes"):
            web.get(f"/data/{file['id']}/file")
        # A part is not compared; whoever puts it together has the digest of the whole.
        assert web.get(f"/data/{file['id']}/file", headers={"Range": "bytes=0-9"}).status_code == 206
    finally:
        path.write_bytes(kept)
