"""A campaign that leaves in a portable folder is the same in the home that it comes to."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import pytest
from support.archives import Clock, entered, everything, registered, run_jobs
from support.homes import initialised
from support.sealing import calibration
from typer.testing import CliRunner

from sms_jobs.archive import Archive, Checker, FolderStore
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.cli.app import app
from sms_jobs.errors import ArchiveCorrupt, Conflict, InvalidInput, NotFound, StorageFull
from sms_jobs.formats import research_crate as crate
from sms_jobs.formats.research_crate import CrateFile
from sms_jobs.jobs.archiving.registration import register_calibration
from sms_jobs.jobs.keeping import verification
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.portable import packing, unpacking
from sms_jobs.jobs.portable.packing import PackOptions
from sms_jobs.jobs.rebuilding import reindexing
from sms_jobs.jobs.running import recovery

NOW = datetime(2026, 3, 2, tzinfo=UTC)


@dataclass(frozen=True)
class Home:
    """A folder with a catalogue and an archive."""

    folder: Path
    catalogue: Catalogue
    archive: Archive
    checker: Checker


@pytest.fixture(scope="module")
def checker() -> Iterator[Checker]:
    with Checker() as reader:
        yield reader


def home(folder: Path, checker: Checker) -> Home:
    initialised(folder)
    catalogue = Catalogue(f"sqlite:///{folder / 'catalogue.sqlite'}")
    return Home(folder, catalogue, Archive(FolderStore(folder / "archive")), checker)


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory, checker: Checker) -> Iterator[Home]:
    """A home with two campaigns, one of them computed to its end, and a calibration that none needs."""
    made, clock = home(tmp_path_factory.mktemp("portable") / "full", checker), Clock()
    registered(made.catalogue, made.archive, clock)
    registered(made.catalogue, made.archive, clock, "other")
    register_calibration(made.catalogue, made.archive, calibration(), clock())
    with made.catalogue.writing() as session:
        recovery.register_worker(session, "w1", "here", 1, ["cpu", "io", "acquisition"], 2, clock())
    kinds = ["simulate", "reconstruct", "correlate", "strain", "merge", "export"]
    run_jobs(made.catalogue, made.archive, clock, [Request(kind) for kind in kinds])
    yield made
    made.catalogue.close()


@pytest.fixture
def empty(tmp_path: Path, checker: Checker) -> Iterator[Home]:
    made = home(tmp_path / "empty", checker)
    yield made
    made.catalogue.close()


def exported(
    full: Home, folder: Path, options: PackOptions, stop_after: int | None = None
) -> list[CrateFile]:
    """Export as the command does; stop where it is said, as if the program were killed there."""
    with full.catalogue.reading() as session:
        parts = packing.chosen(session, options, NOW)
    done = packing.begin(folder, options, parts)
    files: list[CrateFile] = []
    for part in parts:
        before = packing.brought_before(part, done)
        files += before or packing.bring(full.archive, folder, options, part, full.checker)
        if stop_after is not None and len(files) >= stop_after:
            return files
    packing.finish(full.catalogue, full.archive, folder, options, files, NOW)
    return files


def imported(folder: Path, into: Home, **options: Any) -> list[reindexing.Reindexed]:
    manifest = unpacking.manifest_of(folder)
    assert [one for one in unpacking.check(folder, manifest) if one.fault] == []
    return list(
        unpacking.enter(into.catalogue, into.archive, folder, manifest, NOW, checker=into.checker, **options)
    )


def of_campaign(told: dict[str, list[Any]], repacked: bool) -> dict[str, list[Any]]:
    """Leave of all that a catalogue says what is about one campaign; sizes only of files as they were."""
    # What is decided about calibrations of the rig, and of another campaign that has the same, stays behind.
    foreign = {row[4] for row in told["acceptances"] if row[1] != "plate"}
    told = told | {"provenance": [row for row in told["provenance"] if row[0] not in foreign]}
    used = {row[2] for row in told["provenance"]}
    files = [
        row
        for row in told["files"]
        if row[6] == "plate" or row[0] in used | {one[4] for one in told["acceptances"]} - foreign
    ]
    return {
        "files": [row[:3] + row[5:] if repacked and row[0].endswith(".h5") else row for row in files],
        "campaigns": [row for row in told["campaigns"] if row[0] == "plate"],
        "states": [row for row in told["states"] if row[0] == "plate"],
        "calibrations": [row[1:] for row in told["calibrations"] if row[2] in used],
        "acceptances": [row[1:] for row in told["acceptances"] if row[4] not in foreign],
    } | {name: told[name] for name in ("statistics", "provenance", "jobs", "dependencies")}


@pytest.mark.parametrize("how", ["copied", "without plugins"])
def test_a_campaign_comes_to_another_home_as_it_was(
    how: str, full: Home, empty: Home, tmp_path: Path
) -> None:
    folder, repacked = tmp_path / "plate", how == "without plugins"
    files = exported(full, folder, PackOptions("plate", without_plugins=repacked))
    assert not any(one.path.startswith(("other/", "calibrations/rig/")) for one in files)
    rehearsed = imported(folder, empty, dry_run=True)
    assert not any(everything(empty.catalogue).values())
    done = imported(folder, empty)
    assert [one.outcome for one in done] == ["indexed"] * len(done) == [one.outcome for one in rehearsed]
    before, after = everything(full.catalogue), everything(empty.catalogue)
    assert of_campaign(after, repacked) == of_campaign(before, repacked)
    # Nothing else came, and all is well there.
    assert {row[6] for row in after["files"]} == {"plate", None}
    checked = verification.check_known(empty.catalogue, empty.archive, checker=empty.checker)
    assert [one.finding for one in checked if one.finding] == []
    assert list(verification.check_unknown(empty.catalogue, empty.archive)) == []
    assert imported(folder, empty) == []


def test_the_folder_is_an_archive_itself(full: Home, tmp_path: Path) -> None:
    exported(full, tmp_path / "plate", PackOptions("plate"))
    archive = Archive(FolderStore(tmp_path / "plate" / "data"))
    catalogue = Catalogue(f"sqlite:///{tmp_path / 'catalogue.sqlite'}", create=True)
    schema.upgrade(catalogue)
    entered(catalogue, archive, full.checker)
    assert of_campaign(everything(catalogue), False) == of_campaign(everything(full.catalogue), False)
    assert list(verification.check_unknown(catalogue, archive)) == []
    catalogue.close()


READ_ALL = """
import sys
import h5py
def read(name, node):
    if isinstance(node, h5py.Dataset):
        node[()]
for path in sys.argv[1:]:
    with h5py.File(path) as file:
        file.visititems(read)
assert "hdf5plugin" not in sys.modules
"""


def test_without_plugins_every_library_reads_the_files(full: Home, tmp_path: Path) -> None:
    options = PackOptions("plate", kinds=("measurement", "strain"), without_plugins=True)
    files = [one for one in exported(full, tmp_path / "plate", options) if one.path.endswith(".h5")]
    paths = [str(tmp_path / "plate" / "data" / one.path) for one in files]
    subprocess.run([sys.executable, "-c", READ_ALL, *paths], check=True, timeout=120)
    for one, path in zip(files, paths, strict=True):
        with h5py.File(path) as new, h5py.File(full.archive.store.path(one.path)) as old:
            assert tree(new) == tree(old)


def tree(file: Any) -> dict[str, Any]:
    """Return types, shapes and attributes of all that is in a file."""
    found: dict[str, Any] = {}

    def visit(name: str, node: Any) -> None:
        about = {key: (node.attrs.get_id(key).dtype, str(node.attrs[key])) for key in node.attrs}
        found[name] = about, getattr(node, "shape", None), getattr(node, "dtype", None)

    file.visititems(visit)
    visit("/", file)
    return found


@pytest.mark.parametrize("stop_after", [0, 4])
def test_an_interrupted_export_goes_on_and_comes_to_the_same(
    stop_after: int, full: Home, tmp_path: Path
) -> None:
    folder, options = tmp_path / "plate", PackOptions("plate")
    first = exported(full, folder, options, stop_after)
    with pytest.raises(InvalidInput, match="come to its end"):
        unpacking.manifest_of(folder)
    with pytest.raises(Conflict, match="other options"):
        exported(full, folder, replace(options, inputs=False))
    (folder / "data").mkdir(exist_ok=True)
    (folder / "data" / ".x.h5.part").write_bytes(b"half")
    with (folder / ".journal").open("a") as journal:
        journal.write('{"path": "torn')
    times = {one.path: (folder / "data" / one.path).stat().st_mtime_ns for one in first}
    exported(full, folder, options)
    assert times == {path: (folder / "data" / path).stat().st_mtime_ns for path in times}
    whole = tmp_path / "whole"
    exported(full, whole, options)
    assert contents(folder) == contents(whole)


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (errno.EFBIG, "takes no file as large as .*; export to another disk"),
        (errno.ENOSPC, "is full; free some"),
    ],
)
def test_a_disk_that_cannot_hold_a_file_is_named(
    number: int, said: str, full: Home, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def copy_out(*given: object, **options: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Archive, "copy_out", copy_out)
    with pytest.raises(StorageFull, match=said):
        exported(full, tmp_path / "stick", PackOptions("plate"))


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_what_is_chosen_comes_with_what_it_needs(full: Home, tmp_path: Path) -> None:
    with full.catalogue.reading() as session:
        every = packing.chosen(session, PackOptions("plate"), NOW)
        strain = packing.chosen(session, PackOptions("plate", ("strain",)), NOW)
        alone = packing.chosen(session, PackOptions("plate", ("strain",), inputs=False), NOW)
        with pytest.raises(InvalidInput, match="no file of kind strain"):
            packing.chosen(session, PackOptions("other", ("strain",)), NOW)
        with pytest.raises(NotFound):
            packing.chosen(session, PackOptions("nobody"), NOW)
    assert {part.path for part in alone} < {part.path for part in strain} < {part.path for part in every}
    assert sorted(part.description.split()[0] for part in alone) == ["campaign", "strain"]
    assert {part.description.split()[0] for part in strain} == {
        "acceptance",
        "campaign",
        "calibration",
        "measurement",
        "reconstruct",
        "correlate",
        "strain",
    }
    busy = tmp_path / "busy"
    busy.mkdir()
    (busy / "mine.txt").write_text("mine")
    with pytest.raises(Conflict, match="not an empty folder"):
        exported(full, busy, PackOptions("plate"))


def test_a_damaged_file_is_not_exported(full: Home, tmp_path: Path) -> None:
    copy = replace(full, folder=tmp_path, archive=Archive(FolderStore(tmp_path / "archive")))
    shutil.copytree(full.archive.store.root, copy.archive.store.root, dirs_exist_ok=True)
    (victim,) = (p for p in copy.archive.files() if "/strain-" in p)
    file = copy.archive.store.path(victim)
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.chmod(0o644)
    file.write_bytes(data)
    for without in (True, False):
        with pytest.raises(ArchiveCorrupt, match="strain"):
            exported(
                copy, tmp_path / f"to-{without}", PackOptions("plate", ("strain",), without_plugins=without)
            )


def test_an_import_into_a_home_that_knows_some_of_it(full: Home, empty: Home, tmp_path: Path) -> None:
    folder = tmp_path / "plate"
    exported(full, folder, PackOptions("plate"))
    clock = Clock()
    clock()
    # The same rig was calibrated there too, and the calibration entered from another file.
    registered(empty.catalogue, empty.archive, clock, "third")
    done = imported(folder, empty)
    assert {one.outcome for one in done} == {"indexed"}
    assert not any("/calibration-" in one.path for one in done)
    told = everything(empty.catalogue)
    assert len(told["calibrations"]) == 1
    mine = told["calibrations"][0][2]
    edges, theirs = (
        [edge for edge in each["provenance"] if "/acceptance-" not in edge[0]]
        for each in (told, everything(full.catalogue))
    )
    assert len(edges) == len(theirs)
    assert sum(edge[2] == mine for edge in edges) == sum("calibrations/" in e[2] for e in theirs)


def test_what_does_not_fit_is_taken_out_again(full: Home, empty: Home, tmp_path: Path) -> None:
    folder = tmp_path / "plate"
    exported(full, folder, PackOptions("plate", ("strain",), inputs=False))
    (definition,) = (folder / "data" / "plate").glob("campaign-*.h5")
    definition.unlink()
    manifest = unpacking.manifest_of(folder)
    manifest = {path: sha256 for path, sha256 in manifest.items() if "/campaign-" not in path}
    before = contents(empty.archive.store.root)
    done = list(unpacking.enter(empty.catalogue, empty.archive, folder, manifest, NOW, checker=empty.checker))
    assert [one.outcome for one in done] == ["no-campaign"]
    assert contents(empty.archive.store.root) == before


def test_a_file_cannot_pass_for_the_output_of_another_job(full: Home, empty: Home, tmp_path: Path) -> None:
    folder = tmp_path / "plate"
    exported(full, folder, PackOptions("plate"))
    brought = Archive(FolderStore(folder / "data"))
    (strain,) = (path for path in brought.files() if "/strain-" in path)
    (correlated,) = (path for path in brought.files() if "/correlate-" in path)
    with brought.open_unrecorded(strain) as dataset:
        names = {name: dataset.read(name, dataset.record_class(name)) for name in dataset.names}
        told = dataset.provenance
    with brought.open_unrecorded(correlated) as dataset:
        forged = replace(told, job_id=dataset.provenance.job_id)
    made = brought.seal_dataset(names, forged)
    manifest = {f"data/{path}": sha256 for path, sha256 in contents(folder / "data").items()}
    done = unpacking.enter(empty.catalogue, empty.archive, folder, manifest, NOW, checker=empty.checker)
    bad = {one.path: one.detail for one in done if one.outcome != "indexed"}
    assert list(bad) == [made.path]
    assert "is known as correlate of plate/S01/C1P1" in bad[made.path]
    assert not empty.archive.store.path(made.path).exists()


def test_every_change_to_a_folder_is_named(full: Home, tmp_path: Path) -> None:
    folder = tmp_path / "plate"
    exported(full, folder, PackOptions("plate", ("strain",)))
    subprocess.run(["sha256sum", "--check", "--quiet", crate.MANIFEST], cwd=folder, check=True)
    manifest = unpacking.manifest_of(folder)
    lost, altered, linked, *_ = (path for path in manifest if path.endswith(".h5"))
    (folder / lost).unlink()
    (folder / altered).chmod(0o644)
    (folder / altered).write_bytes(b"other")
    target = tmp_path / "elsewhere.h5"
    (folder / linked).rename(target)
    (folder / linked).symlink_to(target)
    (folder / "data" / "more.txt").write_text("more")
    faults = {one.path: one.fault for one in unpacking.check(folder, manifest) if one.fault}
    assert faults == {lost: "missing", altered: "altered", linked: "no-file", "data/more.txt": "unlisted"}


def test_what_describes_a_folder_is_checked_too(full: Home, tmp_path: Path) -> None:
    folder = tmp_path / "plate"
    exported(full, folder, PackOptions("plate", ("strain",)))

    def faults() -> dict[str, str]:
        found = unpacking.check(folder, unpacking.manifest_of(folder))
        return {one.path: one.fault for one in found if one.fault}

    said = folder / crate.INFORMATION
    said.write_text(said.read_text().replace("Payload-Oxum: ", "Payload-Oxum: 1"))
    (folder / crate.DECLARATION).write_text("BagIt-Version: 0.97\n")
    assert faults() == {crate.INFORMATION: "altered", crate.DECLARATION: "altered"}
    told = CliRunner().invoke(app, ["data", "check", str(folder)])
    assert told.exit_code == ArchiveCorrupt.exit_code
    assert crate.INFORMATION in told.stdout
    said.unlink()
    assert faults()[crate.INFORMATION] == "missing"
    # A bag need not have a tag manifest, and files of a tag folder belong to it.
    (folder / crate.TAG_MANIFEST).write_text("0" * 64 + "  notes/read.me\n")
    assert faults() == {"notes/read.me": "missing"}
    (folder / crate.TAG_MANIFEST).unlink()
    assert faults() == {}


@pytest.mark.parametrize("path", ["data/x", "/etc/passwd", "../x", "a/../../x", "a\\b"])
def test_a_tag_manifest_names_files_beside_the_payload(path: str) -> None:
    with pytest.raises(InvalidInput, match=r"line 1 of tagmanifest-sha256\.txt is not a file beside data"):
        crate.read_tag_manifest("0" * 64 + f"  {path}\n")


@pytest.mark.parametrize(
    "line",
    [
        "0" * 64 + "  data/../../etc/passwd",
        "0" * 64 + "  /etc/passwd",
        "0" * 64 + "  bagit.txt",
        "0" * 64 + "  data//x",
        "0" * 63 + "  data/x",
        "0" * 64,
        "0" * 64 + "  data/x\n" + "1" * 64 + "  data/x",
    ],
)
def test_a_manifest_names_files_inside_the_payload_once(line: str) -> None:
    with pytest.raises(InvalidInput, match="line"):
        crate.read_manifest(line + "\n")


def test_names_of_any_kind_come_back_from_a_manifest() -> None:
    hashes = {"data/a%0Ab": "0" * 64, "data/a\nb": "1" * 64, "data/ä b": "2" * 64}
    assert crate.read_manifest(crate.manifest(hashes)) == hashes


def test_the_crate_describes_every_file(full: Home, tmp_path: Path) -> None:
    folder = tmp_path / "plate"
    exported(full, folder, PackOptions("plate"))
    described = json.loads((folder / "data" / crate.METADATA).read_text())
    graph = {one["@id"]: one for one in described["@graph"]}
    assert graph[crate.METADATA]["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
    assert graph[crate.METADATA]["about"] == {"@id": "./"}
    root = graph["./"]
    assert root["@type"] == "Dataset"
    assert datetime.fromisoformat(root["datePublished"]) == NOW
    parts = {part["@id"] for part in root["hasPart"]}
    payload = unpacking.manifest_of(folder)
    assert {f"data/{name}" for name in parts} == set(payload) - {f"data/{crate.METADATA}"}
    for name in parts:
        assert graph[name]["@type"] == "File"
        assert graph[name]["sha256"] == payload[f"data/{name}"]
        assert int(graph[name]["contentSize"]) == (folder / "data" / name).stat().st_size
    said = (folder / "bag-info.txt").read_text()
    size = sum((folder / path).stat().st_size for path in payload)
    assert f"Payload-Oxum: {size}.{len(payload)}\n" in said
    assert os.access(folder / crate.TAG_MANIFEST, os.R_OK)


def told_by(*arguments: str) -> str:
    """Run a command of `sms data` in this process; return what it prints on stdout."""
    done = CliRunner().invoke(app, ["data", *arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


def test_the_commands_take_a_campaign_from_home_to_home(full: Home, tmp_path: Path) -> None:
    folder, there = str(tmp_path / "plate"), ("--home", str(tmp_path / "there"))
    options = ("--kind", "strain", "--link", "--home", str(full.folder))
    told_by("pack", "-c", "plate", "--to", folder, *options)
    told_by("check", folder)
    initialised(tmp_path / "there")
    told = CliRunner().invoke(app, ["data", "unpack", folder, *there])
    assert told.exit_code == 0
    assert "came along and is used for plate; 'sms calibration accept 1'" in " ".join(told.stderr.split())
    files = everything(full.catalogue)["files"]
    (strain,) = (row[0] for row in files if row[1] == "strain")
    first = next(row[0] for row in files if row[1] == "calibration")
    down = json.loads(told_by("tree", first, "--down", "--json", *there))
    assert {one["file"]["source"] for one in down["outputs"]} >= {"reconstruct", "correlate"}
    assert strain in json.dumps(down)
    assert f"calibration ({down['file']['id']})" in told_by("tree", strain, *there)
    again = CliRunner().invoke(app, ["data", "unpack", folder, *there])
    assert "nothing is new: every file of the folder is in the catalogue already" in again.stderr
    document = tmp_path / "strain.prov.json"
    told_by("provenance", strain, "--output", str(document), *there)
    entities = json.loads(document.read_text())["entity"].values()
    assert {strain, first} <= {one["prov:location"] for one in entities}
    (Path(folder) / "data" / "more.txt").write_text("more")
    assert CliRunner().invoke(app, ["data", "check", folder]).exit_code == ArchiveCorrupt.exit_code
    assert CliRunner().invoke(app, ["data", "unpack", folder, *there]).exit_code == ArchiveCorrupt.exit_code
