"""The report and the exports, made of results that lie in a real archive."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from sms_jobs.archive import Archive, Provenance
from sms_jobs.errors import InvalidInput
from sms_jobs.kinds import all_kinds, export, report
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, DocumentOutput, Inputs, Need
from sms_jobs.metrology.geometry.camera import Intrinsics, Pose
from sms_jobs.records.assessment import Assessment, Errors
from sms_jobs.records.campaign import Campaign, LoadState, Specimen, Subject
from sms_jobs.records.fields import MergedField, Mesh, PointCloud, Region, Regions, StrainField
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.scene import HalvesApart, Plane, Scene
from sms_jobs.records.sensors import Box, Calibration, Rig, Role, Sensor

WHEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
CAMERAS = ("C1", "C2")
POSE = Pose(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 500.0))


def campaign(
    states: int = 2, virtual: bool = True, material: str = "", pairs: tuple[str, ...] = ("C1P1",)
) -> Campaign:
    loads = tuple(
        LoadState(f"S{i:02}", load_n=1234.5 * i, deformation=(HalvesApart(0.1 * i),)) for i in range(states)
    )
    scene = Scene(Rig("rig", ()), Plane(100.0, 100.0)) if virtual else None
    specimen = Specimen("panel", material=material)
    return Campaign("plate", specimen, "rig", loads, pairs, scene=scene)


def grid(size: tuple[int, int]) -> Any:
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    scale = 300.0 / size[1]
    return x * scale, y * scale, 40.0 * np.cos(x * scale / 60.0)


def records_for(need: Need, size: tuple[int, int]) -> Mapping[str, Any]:
    """Return plausible results for what the report needs."""
    rng = np.random.default_rng(1)
    x, y, z = grid(size)
    load = int((need.subject.state or "S00")[1:])
    reason = np.zeros(size, np.uint32)
    reason[: size[0] // 5, : size[1] // 4] = 1
    hole = np.where(reason > 0, np.nan, 1.0)
    full = np.stack([hole] * 3)
    covariance = np.full((6, *size), 1e-4, np.float32) * np.concatenate([full, full]).astype(np.float32)
    shift = np.stack([0.01 * x, -0.003 * y, 0.2 * z]) * 0.1 * load * full
    errors = Errors(100, 0.02, 0.001, 0.1, 1.05, 120, 0.97, 0)
    if need.source == CALIBRATION:
        sensor = Sensor("C1", Role.CAMERA, size[1], size[0], Intrinsics(1e3, 1e3, 40.0, 30.0), POSE)
        box = Box((0.0, 0.0, 0.0), (300.0, 400.0, 0.0))
        return {"calibration": Calibration(Rig("rig", (sensor,)), box, WHEN, "exact")}
    if need.source == MEASUREMENT:
        texture = (1500 + 700 * np.sign(np.sin(x) * np.sin(y)) + rng.normal(0, 40, size)).astype(np.uint16)
        frames = ArrayStack(texture[None])
        return {"measurement": Measurement(WHEN, FringeSequence(), 4095, 0.1, 2.0, texture, frames)}
    if need.source == "reconstruct":
        gap = np.zeros(size, np.float32)
        if need.subject.pair == "C1P1":
            reason = reason | 1  # sees nothing: its neighbour C1P2 is shown
        return {"cloud": PointCloud("C1", "P1", np.stack([x, y, z]) * full, covariance, gap, reason)}
    if need.source == "correlate":
        labels = np.where(z > 0, 1, 2).astype(np.int32) * (reason == 0)
        return {
            "regions": Regions((Region(1, 9, (1.0, 1.0)), Region(2, 8, (1.0, 1.0))), labels.astype(np.int32))
        }
    if need.source == "strain":
        strain = np.stack([0.001 + 1e-5 * x, -0.0003 + 0 * x, 0 * x]) * load * full
        sigma = np.full((3, *size), 3e-5, np.float32)
        return {"strain": StrainField("small", 20.0, strain, sigma, strain[:2], strain[0], reason)}
    if need.source == "merge":
        names = np.ones(size, np.uint8)
        fields = {
            c: MergedField(c, ("C1P1", "C1P2"), 0.012, shift, np.stack([x, y, z]), covariance, names, reason)
            for c in CAMERAS
        }
        return {**fields, "mesh": mesh()}
    assert need.source == "assess", need
    return {"assessment": Assessment(errors, errors, replace(errors, rms=42e-6), np.zeros(size, np.float32))}


def mesh() -> Mesh:
    corners = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    return Mesh(("u",), ("mm",), corners, np.array([[0, 1, 2]], np.int32), np.ones((1, 3)))


Run = Callable[..., tuple[list[DocumentOutput], Archive]]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Run a kind on files of an archive; what it writes lands in the archive as a job's outputs do."""

    def run_kind(
        kind: Any,
        campaign: Campaign,
        subject: Subject,
        size: tuple[int, int] = (45, 60),
        instead: Any = None,
        **given: Any,
    ) -> Any:
        archive = Archive(tmp_path / "archive")
        with ExitStack() as stack:
            datasets = {}
            for place, need in enumerate(kind.needs(campaign, subject)):
                made = Provenance(
                    need.source,
                    1,
                    need.subject,
                    f"{place:032x}",
                    place,
                    WHEN,
                    {"a<b": 1},
                    (),
                    "0.1",
                    "h<1>",
                    "me",
                )
                changed = instead if instead and need.source == "merge" else {}
                sealed = archive.seal_dataset({**records_for(need, size), **changed}, made)
                datasets[need.role] = stack.enter_context(archive.open(sealed.path))
            inputs = Inputs(subject, kind.context(campaign, subject), datasets)
            told: list[float] = []
            documents = []
            for output in kind.run(inputs, kind.parameters(**given), lambda part, _="": told.append(part)):
                path = tmp_path / output.filename
                output.write(path)
                documents.append((output, path))
            assert told == sorted(told)
            assert 0.0 <= told[0] <= told[-1] <= 1.0
        return documents

    return run_kind


class Checker(HTMLParser):
    """Collects what matters of a page, and checks that every element is closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.images: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = dict(attributes)
        if tag not in ("img", "meta", "br"):
            self.open.append(tag)
        if tag == "img":
            self.images.append(found["src"] or "")
            assert found["alt"]
        self.links += [value or "" for name, value in attributes if name in ("href", "src")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.words.append(data)

    @classmethod
    def of(cls, page: str) -> Checker:
        checker = cls()
        checker.feed(page)
        checker.close()
        assert checker.open == []
        return checker


def test_the_kinds_are_found_by_themselves() -> None:
    assert all_kinds()["report"] is report.KIND
    assert all_kinds()["export"] is export.KIND


def test_a_report_is_one_page_that_needs_nothing_else(run: Run) -> None:
    ((output, path),) = run(report.KIND, campaign(3, pairs=("C1P1", "C1P2", "C2P1")), Subject("plate"))
    assert (output.filename, output.media_type) == ("plate-report.html", "text/html")
    page = Checker.of(path.read_text(encoding="utf-8"))
    words = " ".join(page.words)
    # 2 cameras: 3 pictures each at rest, 4 each in each of 2 deformed states.
    assert len(page.images) == 2 * 3 + 2 * 2 * 4
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in page.links)
    assert "C1 (C1P2)" in page.words  # of the two pairs of C1 the one that sees something
    assert "C1 (C1P1)" not in page.words
    # A volume of 300 x 400 mm: its diagonal is 500 mm, and 0.02 mm of error the 25,000th part of it.
    for text in ("panel", "C1P2", "2469", "500 mm", "25000", "42", "97", "Accuracy", "merge, version 1"):
        assert text in words, text


def test_everything_that_people_wrote_is_escaped(run: Run) -> None:
    evil = '<img src=x onerror=alert(1)> & "quotes"'
    ((_, path),) = run(report.KIND, campaign(material=evil), Subject("plate"))
    page = Checker.of(path.read_text(encoding="utf-8"))
    assert evil in page.words
    assert not [source for source in page.images if not source.startswith("data:")]
    assert '{"a<b": 1}' in page.words


def test_a_real_campaign_has_no_table_of_errors(run: Run) -> None:
    needs = list(report.needs(campaign(virtual=False), Subject("plate")))
    assert "assess" not in {need.source for need in needs}
    ((_, path),) = run(report.KIND, campaign(virtual=False), Subject("plate"))
    assert "Accuracy" not in path.read_text(encoding="utf-8")


def test_a_campaign_with_its_reference_state_alone_has_a_report(run: Run) -> None:
    ((_, path),) = run(report.KIND, campaign(states=1), Subject("plate"))
    page = Checker.of(path.read_text(encoding="utf-8"))
    assert len(page.images) == 3
    assert "Maps of the deformed states" not in page.words


def test_many_states_leave_out_maps_but_no_numbers(run: Run) -> None:
    long = campaign(states=9, virtual=False)
    shown = [state.label for state in report.shown_states(long, 3)]
    assert len(shown) == 3
    assert shown[-1] == "S08"
    assert [s.label for s in report.shown_states(long, 1000)] == [f"S{i:02}" for i in range(1, 9)]
    made = run(report.KIND, long, Subject("plate"), most_states=3, figure_width_px=240)
    assert [output.filename for output, _ in made] == ["plate-report.html", "plate-report-states.zip"]
    words = Checker.of(made[0][1].read_text(encoding="utf-8")).words
    assert any(word.startswith("Maps are shown of 3 of the 8 deformed states.") for word in words)
    assert all(words.count(f"S{i:02}") >= 2 for i in range(1, 9))
    with zipfile.ZipFile(made[1][1]) as folder:
        labels = [f"S{i:02}" for i in range(1, 9)]
        assert folder.namelist() == ["index.html", *(f"{label}.html" for label in labels)]
        index = Checker.of(folder.read("index.html").decode())
        assert [link for link in index.links if link.startswith("S")] == [f"{label}.html" for label in labels]
        last = Checker.of(folder.read("S08.html").decode())
        assert len(last.images) == 4
        assert [link for link in last.links if link.endswith(".html")] == ["index.html", "S07.html"]


def test_the_report_of_the_same_results_is_the_same(run: Run, tmp_path: Path) -> None:
    ((_, path),) = run(report.KIND, campaign(states=1), Subject("plate"))
    first = path.read_bytes()
    for file in sorted((tmp_path / "archive").rglob("*.h5")):
        file.unlink()
    ((_, path),) = run(report.KIND, campaign(states=1), Subject("plate"))
    assert path.read_bytes() == first


def test_export_writes_every_format_once(run: Run) -> None:
    documents = run(export.KIND, campaign(), Subject("plate", "S01"))
    assert [path.name for _, path in documents] == [
        f"plate-S01{suffix}" for suffix in (".csv", ".obj", ".ply", ".stl", ".dat", ".vtu")
    ]
    assert all(path.stat().st_size > 0 for _, path in documents)
    assert ET.parse(documents[-1][1]).getroot().tag == "VTKFile"


def test_export_writes_only_what_is_asked_for(run: Run) -> None:
    documents = run(export.KIND, campaign(states=3), Subject("plate", "S02"), formats=("stl", "stl", "ply"))
    assert [output.media_type for output, _ in documents] == ["model/stl", "model/x-ply"]
    with pytest.raises(ValidationError, match=re.escape("there is no format docx; choose among csv, e57")):
        export.ExportParameters(formats=("docx",))
    with pytest.raises(ValidationError):
        export.ExportParameters(formats=())
    alone = export.ExportParameters.model_validate({"formats": "stl", "fields": "displacement Z"})
    assert (alone.formats, alone.fields) == (("stl",), ("displacement Z",))


def test_export_gives_each_vertex_the_texture_of_its_pixel(run: Run) -> None:
    x, y, z = grid((45, 60))
    row, column = np.array([3, 3, 4]), np.array([5, 6, 5])
    corners = np.stack([x, y, z], axis=-1)[row, column]
    of_pixels = Mesh(("u",), ("mm",), corners, np.array([[0, 1, 2]], np.int32), np.ones((1, 3)))
    subject = Subject("plate", "S02")
    ((_, path),) = run(export.KIND, campaign(), subject, formats=("npz",), instead={"mesh": of_pixels})
    need = Need("", MEASUREMENT, Subject("plate", "S00", "C1P1"))
    texture = records_for(need, (45, 60))["measurement"].texture
    with np.load(path) as found:
        # Full scale is 4095; single precision.
        np.testing.assert_allclose(found["texture"], texture[row, column] / 4095, rtol=2.0**-23)


def test_export_leaves_out_a_texture_that_no_vertex_has(run: Run) -> None:
    ((_, path),) = run(export.KIND, campaign(), Subject("plate", "S01"), formats=("npz",))
    with np.load(path) as found:
        # The corners of this mesh are no pixels of the camera.
        assert list(found["names"]) == ["vertices_mm", "faces", "u_mm"]


def test_export_writes_a_file_for_each_camera_where_points_are_over_an_image(run: Run) -> None:
    two = campaign(pairs=("C1P1", "C2P1"))
    documents = run(export.KIND, two, Subject("plate", "S01"), formats=("ptx", "e57", "xyz"))
    assert [path.name for _, path in documents] == [
        *("plate-S01-C1.ptx", "plate-S01-C2.ptx", "plate-S01-C1.e57", "plate-S01-C2.e57", "plate-S01.xyz")
    ]
    head = documents[0][1].read_text().splitlines()[:2]
    assert head == ["60", "45"]


def test_export_writes_the_fields_that_are_asked_for(run: Run) -> None:
    ((_, path),) = run(export.KIND, campaign(), Subject("plate", "S01"), formats=("csv",), fields=("u",))
    assert path.read_text().splitlines()[0] == '"X [mm]","Y [mm]","Z [mm]","u [mm]"'


def test_export_names_the_fields_that_there_are(run: Run) -> None:
    with pytest.raises(InvalidInput, match="has no field 'w'; choose among u"):
        run(export.KIND, campaign(), Subject("plate", "S02"), formats=("csv",), fields=("w",))
