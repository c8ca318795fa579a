"""Reference surfaces in catalogue and archive, and results that leave it in other formats."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.archives import entered
from support.homes import WHEN, initialised, make_home, stored

from sms_jobs import bootstrap
from sms_jobs.app.fields.exporting import formats_of
from sms_jobs.app.fields.field_gauges import gauge_at
from sms_jobs.app.fields.field_sources import fields_of
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.cli import exporting
from sms_jobs.cli.importing import surface
from sms_jobs.errors import Conflict, InvalidInput, NotFound
from sms_jobs.formats.exporters import all_exporters, exporter_named
from sms_jobs.jobs.archiving.surfaces import register_surface
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.kinds.kind import REFERENCE_SURFACES
from sms_jobs.records.fields import Mesh, Region, Regions, Surface
from sms_jobs.records.surfaces import ReferenceSurface
from sms_jobs.virtual_rig.campaigns import small_plate

CORNERS = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
TRIANGLE = np.array([[0, 1, 2]], np.int32)


@pytest.fixture
def services(home: Path) -> Iterator[Services]:
    make_home(home, {})
    with bootstrap.services(home) as opened:
        yield opened


def reference(scale: float = 1.0) -> ReferenceSurface:
    return ReferenceSurface("part.stl", "0" * 64, "mm", False, scale * CORNERS, TRIANGLE)


def cloud(height: float = 0.0) -> Surface:
    y, x = np.mgrid[0:6, 0:8].astype(float)
    zeros = np.zeros((6, 8), np.float32)
    return Surface(
        "C1P1",
        "mm",
        np.stack([x, y, height + 0.0 * x]),
        zeros.astype(np.uint32),
        np.full((6, 6, 8), 1e-6, np.float32),
        zeros,
    )


def mesh() -> Mesh:
    return Mesh(("u", "v"), ("mm", "1"), CORNERS, TRIANGLE, np.ones((2, 3)))


def test_the_newest_surface_of_a_campaign_counts_and_is_entered_once(services: Services) -> None:
    def add(surface: ReferenceSurface, seconds: int) -> tuple[int, bool]:
        at = WHEN + timedelta(seconds=seconds)
        return register_surface(services.catalogue, services.archive, "plate", surface, at)

    first, new = add(reference(), 0)
    assert new
    assert add(reference(), 0) == (first, False)
    second, new = add(reference(2.0), 0)  # within the same second
    assert new
    assert second != first
    third, new = add(reference(), 1)  # back to the first: the newest has to be that again
    assert new
    with services.catalogue.reading() as session:
        files = search.find_files(session, source=REFERENCE_SURFACES, campaign="plate")
        assert [f.id for f in files] == [third, second, first]
        assert search.statistics(session, third) == {"vertices": 3.0, "faces": 1.0}
    with services.archive.open(files[0]) as dataset:
        np.testing.assert_array_equal(dataset.read("reference", ReferenceSurface).vertices, CORNERS)
        assert dataset.provenance.parameters["file_sha256"] == "0" * 64
    with pytest.raises(NotFound, match="no campaign 'other'"):
        register_surface(services.catalogue, services.archive, "other", reference(), WHEN)


def test_a_comparison_needs_a_surface_and_takes_the_newest(services: Services) -> None:
    for view in small_plate("plate")[1].views:
        stored(services, "reconstruct", f"plate/S00/{view}", {"surface": cloud()})
    request = [Request("deviate", states=("S00",))]
    with (
        pytest.raises(NotFound, match="bring one in with 'sms import surface FILE -c plate'"),
        services.catalogue.writing() as session,
    ):
        submit(session, "plate", request, WHEN)
    register_surface(services.catalogue, services.archive, "plate", reference(), WHEN)
    with services.catalogue.writing() as session:
        assert submit(session, "plate", request, WHEN).kinds == ("deviate",)


def test_surfaces_are_told_by_files_alone(services: Services, tmp_path: Path) -> None:
    for scale, seconds in ((1.0, 0), (2.0, 0), (3.0, 1)):
        at = WHEN + timedelta(seconds=seconds)
        register_surface(services.catalogue, services.archive, "plate", reference(scale), at)
    other = tmp_path / "again"
    initialised(other)
    with bootstrap.services(other) as again:
        entered(again.catalogue, services.archive)
        with again.catalogue.reading() as session:
            found = search.find_files(session, source=REFERENCE_SURFACES, campaign="plate")
            assert len(found) == 3
            newest = found[0]
            assert newest.job_id is None
            assert search.statistics(session, newest.id) == {"vertices": 3.0, "faces": 1.0}
        with services.archive.open(newest) as dataset:
            np.testing.assert_array_equal(dataset.read("reference", ReferenceSurface).vertices, 3.0 * CORNERS)


def test_a_surface_is_imported_from_a_file(
    services: Services, home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "part.stl"
    exporter_named("stl").write(mesh(), path)
    surface.surface(path, "plate", unit="cm", home=home, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert (told["new"], told["triangles"], told["size_mm"]) == (True, 1, [100.0, 100.0, 0.0])
    surface.surface(path, "plate", unit="cm", home=home)
    assert f"is already file {told['file']}" in capsys.readouterr().err


def export(home: Path, file: str | None = None, **given: Any) -> None:
    """Call the command as typer would, with every option at its default."""
    options: dict[str, Any] = dict.fromkeys(
        ("form", "out", "record", "fields", "kind", "campaign", "state", "view")
    )
    exporting.export(file, **(options | {"force": False, "home": home, "as_json": False} | given))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def test_a_result_is_written_in_the_format_that_is_asked_for(
    services: Services, home: Path, here: Path
) -> None:
    number = str(stored(services, "merge", "plate/S01", {"C1": cloud(), "mesh": mesh()}))
    export(home, number, form="obj")
    assert (here / "plate-S01-merge.obj").read_text().count("\nf ") == 1
    export(home, number, out=here / "other.vtu", fields="v")
    assert 'Name="v [1]"' in (here / "other.vtu").read_text()
    assert 'Name="u [mm]"' not in (here / "other.vtu").read_text()
    export(home, number, form="csv", record="C1")
    assert len((here / "plate-S01-merge.csv").read_text().splitlines()) == 1 + 6 * 8
    export(home, number, out=here / "sealed.h5")
    with services.catalogue.reading() as session:
        sealed = services.archive.store.path(search.file_view(session, number).path)
    assert (here / "sealed.h5").read_bytes() == sealed.read_bytes()


def test_the_newest_of_a_kind_of_each_subject(services: Services, home: Path, here: Path) -> None:
    for number, (state, height) in enumerate((("S00", 1.0), ("S01", 2.0), ("S00", 3.0))):
        stored(services, "reconstruct", f"plate/{state}/C1P1", {"surface": cloud(height)}, number)
    export(home, kind="reconstruct", campaign="plate", form="xyz")
    assert sorted(p.name for p in here.iterdir()) == [
        "plate-S00-C1P1-reconstruct.xyz",
        "plate-S01-C1P1-reconstruct.xyz",
    ]
    np.testing.assert_array_equal(np.loadtxt("plate-S00-C1P1-reconstruct.xyz", comments="//")[:, 2], 3.0)
    with pytest.raises(InvalidInput, match="2 files are to be written"):
        export(home, kind="reconstruct", campaign="plate", form="xyz", out=here / "one.xyz")
    stored(services, "report", "plate", None, 7)
    export(home, kind="report", campaign="plate")
    (page,) = here.glob("*.html")
    assert page.read_text() == "<p>page</p>"


def test_several_results_are_written_in_their_natural_order(
    services: Services, home: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, view in enumerate(("C10P1", "C2P1", "C1P1")):
        stored(services, "reconstruct", f"plate/S00/{view}", {"surface": cloud()}, number)
    export(home, kind="reconstruct", campaign="plate", form="xyz", as_json=True)
    written = [Path(name).name for name in json.loads(capsys.readouterr().out)["files"]]
    assert written == [f"plate-S00-{view}-reconstruct.xyz" for view in ("C1P1", "C2P1", "C10P1")]


def test_sealed_files_of_several_subjects_have_names_of_their_own_and_are_all_written_or_none(
    services: Services, home: Path, here: Path
) -> None:
    for state in ("S00", "S01"):
        stored(services, "reconstruct", f"plate/{state}/C1P1", {"surface": cloud(1.0)})
    export(home, kind="reconstruct", campaign="plate")
    written = sorted(p.name for p in here.glob("*-reconstruct-*.h5"))
    assert [name[:14] for name in written] == ["plate-S00-C1P1", "plate-S01-C1P1"]
    (here / written[0]).unlink()
    with pytest.raises(Conflict, match=f"{written[1]} already exists"):
        export(home, kind="reconstruct", campaign="plate")
    assert not (here / written[0]).exists()


def test_several_records_need_a_choice_or_a_folder(services: Services, home: Path, here: Path) -> None:
    number = str(stored(services, "merge", "plate/S01", {"C1": cloud(), "C2": cloud(1.0), "mesh": mesh()}))
    with pytest.raises(InvalidInput, match="has the records C1, C2: choose one as `record`, or give"):
        export(home, number, out=here / "x.ptx")
    export(home, number, form="ptx", out=here)
    assert sorted(p.name for p in here.iterdir()) == [
        "plate-S01-merge-C1.ptx",
        "plate-S01-merge-C2.ptx",
    ]
    with pytest.raises(Conflict, match="already exists"):
        export(home, number, form="ptx")
    export(home, number, form="ptx", force=True)


def test_the_ending_of_a_file_is_that_of_its_format(services: Services, home: Path, here: Path) -> None:
    number = str(stored(services, "merge", "plate/S01", {"mesh": mesh()}))
    page = str(stored(services, "report", "plate", None))
    for given, words in (
        ({"file": number, "out": here / "x.html"}, r"ends as no format does.* ply \(\*\.ply\)"),
        ({"file": number, "out": here / "no-folder"}, "no folder that is there"),
        ({"file": number, "form": "ply", "out": here / "x"}, r"must end in \.ply to be a file of ply"),
        ({"file": number, "form": "hdf5", "out": here / "x.ply"}, r"must end in \.h5"),
        ({"file": page, "out": here / "x.ply"}, r"must end in \.html"),
    ):
        with pytest.raises(InvalidInput, match=words):
            export(home, **given)  # type: ignore[arg-type]
    for form in all_exporters().values():
        with pytest.raises(InvalidInput, match=f"to be a file of {form.name}; there are"):
            export(home, number, form=form.name, out=here / "x.html")
    assert list(here.iterdir()) == []
    export(home, number, form="tecplot-block", out=here / "x.dat")
    assert "DATAPACKING=BLOCK" in (here / "x.dat").read_text().replace(" ", "")


def test_wrong_requests_are_refused_with_a_way_out(services: Services, home: Path, here: Path) -> None:
    number = str(stored(services, "merge", "plate/S01", {"mesh": mesh()}))
    page = str(stored(services, "report", "plate", None))
    for given, words in (
        ({"file": number, "form": "plyy"}, "choose one of csv, e57"),
        ({"file": number, "form": "ply", "fields": "w"}, "choose among u, v"),
        ({"file": number, "form": "ply", "fields": "u,,v"}, "empty name"),
        ({"file": number, "fields": "u"}, "need a format"),
        ({"file": number, "form": "ptx"}, "points in the order of an image"),
        ({"file": page, "form": "ply"}, "leave the format out"),
        ({"file": number, "kind": "merge"}, "name one file"),
        ({}, "name one file"),
        ({"kind": "merge"}, "a `kind` needs a `campaign`"),
        ({"file": number, "campaign": "plate"}, "go with a `kind`"),
        ({"file": number, "form": "ply", "out": here / "no" / "x.ply"}, "make it first"),
    ):
        with pytest.raises(InvalidInput, match=words):
            export(home, **given)  # type: ignore[arg-type]
    with pytest.raises(NotFound, match="no such result of kind strain"):
        export(home, kind="strain", campaign="plate")
    with pytest.raises(NotFound, match="no record 'C9'"):
        export(home, number, form="ply", record="C9")
    assert list(here.iterdir()) == []


def test_a_result_is_written_without_plugins(services: Services, home: Path, here: Path) -> None:
    number = str(stored(services, "reconstruct", "plate/S00/C1P1", {"surface": cloud()}))
    export(home, number, form="hdf5")
    with h5py.File(here / "plate-S00-C1P1-reconstruct.h5") as file:
        xyz = file["entry/surface/position"]
        assert xyz.compression == "gzip"
        np.testing.assert_array_equal(xyz, cloud().position)
        assert xyz.attrs["units"] == "mm"
    with pytest.raises(InvalidInput, match="takes the whole file"):
        export(home, number, form="hdf5", fields="position")
    export(home, number, form="hdf5", force=True)


def test_formats_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    exporting.formats(as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert {"format": "ply", "suffix": ".ply", "summary": exporter_named("ply").summary} in told
    exporting.formats()
    assert "tecplot-block" in capsys.readouterr().out


def test_the_formats_that_are_offered_of_a_file_can_be_written(
    services: Services, home: Path, here: Path
) -> None:
    regions = Regions((Region(1, 9, (1.0, 1.0)),), np.ones((3, 3), np.int32))
    for kind, records, lacks in (
        ("reconstruct", {"surface": cloud()}, set()),
        ("combine", {"mesh": mesh()}, {"e57", "ptx"}),
        ("correlate", {"regions": regions}, set(all_exporters()) - {"csv", "npz", "matlab"}),
    ):
        number = str(stored(services, kind, "plate/S01/C1P1", records))
        offered = {one.name for one in formats_of(services, number)}
        assert offered == {*all_exporters(), "hdf5"} - lacks
        for form in offered:
            export(home, number, form=form, out=here, force=True)
        for form in lacks:
            with pytest.raises(InvalidInput):
                export(home, number, form=form, out=here, force=True)


def test_a_gauge_on_a_part_that_a_file_lacks_is_refused_with_those_it_has(services: Services) -> None:
    number = str(stored(services, "correlate", "plate/S01/C1P1", {"surface": cloud()}))
    for part, has in (("C9", "C1"), ("c1", "C1")):
        with pytest.raises(NotFound, match=f"^file {number} has no part '{part}'; it has {has}$"):
            gauge_at(services, number, "G1 x=4 y=3 length=4", part=part)
    other = str(stored(services, "reconstruct", "plate/S01/C1P1", {"surface": cloud()}))
    with pytest.raises(InvalidInput, match="computed from no displacement"):
        gauge_at(services, other, "G1 x=4 y=3 length=4", part="C9")
    with pytest.raises(NotFound, match=f"^file {other} has no part 'C9'; leave the part out$"):
        fields_of(services, other, "C9")
    with pytest.raises(InvalidInput, match=r"^file 1 \(campaign\) has no field over an image; choose"):
        fields_of(services, "1")
