"""The report and the exports, made of results that lie in a real archive."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from support.report_results import campaign, mesh, records_for, run_on_results

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.report.tables import local_time
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.documents import DocumentOutput
from sms_jobs.kinds.kind import MEASUREMENT, Port
from sms_jobs.kinds.reporting import export, report
from sms_jobs.kinds.reporting import state_report as report_state
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.subject import Subject
from sms_jobs.records.times import UNTIMED

Run = Callable[..., list[tuple[DocumentOutput, Path]]]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Run a kind on files of an archive; what it writes lands in the test's folder."""
    return partial(run_on_results, tmp_path)


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
    ((output, path),) = run(report.KIND, campaign(3, views=("C1P1", "C1P2", "C2P1")), Subject("plate"))
    assert (output.filename, output.media_type) == ("plate-report.html", "text/html")
    page = Checker.of(path.read_text(encoding="utf-8"))
    words = " ".join(page.words)
    # 2 cameras: 3 pictures each at rest, 4 each in each of 2 deformed states.
    assert len(page.images) == 2 * 3 + 2 * 2 * 4
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in page.links)
    assert "C1 (C1P2)" in page.words  # of the two views of C1 the one that sees something
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
    needs = list(report.needs(campaign(virtual=False), Subject("plate"), report.ReportParameters()))
    assert "assess" not in {need.source for need in needs}
    ((_, path),) = run(report.KIND, campaign(virtual=False), Subject("plate"))
    assert "Accuracy" not in path.read_text(encoding="utf-8")


def test_a_campaign_with_its_reference_state_alone_has_a_report(run: Run) -> None:
    ((_, path),) = run(report.KIND, campaign(states=1), Subject("plate"))
    page = Checker.of(path.read_text(encoding="utf-8"))
    assert len(page.images) == 3
    assert "Maps of the deformed states" not in page.words


@pytest.mark.parametrize("at", [datetime(2026, 5, 4, 10, tzinfo=UTC), UNTIMED])
def test_a_time_is_in_the_page_where_there_is_one(run: Run, at: datetime) -> None:
    image = np.zeros((45, 60), np.uint16)
    recorded = Measurement(at, FringeSequence(), 4095, 0.1, 2.0, image, ArrayStack(image[None]))
    ((_, path),) = run(report.KIND, campaign(), Subject("plate"), instead={"measurement": recorded})
    # A simulated state without a time bears one at which nobody recorded anything.
    words = Checker.of(path.read_text(encoding="utf-8")).words
    assert (str(local_time(at)) in words) == (at != UNTIMED)


def test_many_states_have_maps_in_one_page_and_few_of_them_pictures(run: Run) -> None:
    labels = [f"S{i:02}" for i in range(1, 6)]
    long = campaign(states=6, virtual=False)
    pictured = [state.label for state in report.pictured_states(long, 2)]
    assert len(pictured) == 2
    assert pictured[-1] == "S05"
    assert [s.label for s in report.pictured_states(long, 1000)] == labels
    ((_, path),) = run(report.KIND, long, Subject("plate"), most_states=2, figure_width_px=240)
    text = path.read_text(encoding="utf-8")
    page = Checker.of(text)
    assert len(page.images) == 3 + 2 * 4
    assert any("Still pictures, for print, are of 2 of the 5 deformed states." in w for w in page.words)
    # Each is led to from the table of states.
    assert {f"#state-{label}" for label in labels} <= set(page.links)
    assert re.findall('class="(state[^"]*)" id="state-(S..)"', text) == [
        ("state" if label in pictured else "state unpictured", label) for label in labels
    ]
    assert "coarser" not in " ".join(page.words)


def test_positions_at_rest_are_in_the_page_once(run: Run) -> None:
    ((_, path),) = run(report.KIND, campaign(states=4), Subject("plate"), figure_width_px=240)
    text = path.read_text(encoding="utf-8")
    abouts = [json.loads(found) for found in re.findall('class="about">(.*?)</script>', text)]
    held = {
        (view["state"], field["name"]): field["data"]
        for view in abouts
        for field in view["fields"]
        if field["name"].startswith("position")
    }
    for axis in "XYZ":
        first = held["S01", f"position {axis}"]
        assert {held[f"S{i:02}", f"position {axis}"] for i in (1, 2, 3)} == {first}
        assert text.count(f'id="{first}"') == 1


def test_a_page_that_would_be_too_large_has_coarser_maps_and_says_so(run: Run) -> None:
    long = campaign(states=9, virtual=False)
    given = {"size": (480, 640), "map_px": 640, "most_states": 1, "figure_width_px": 240}
    ((_, path),) = run(report.KIND, long, Subject("plate"), most_mb=1, **given)
    assert path.stat().st_size <= 1e6
    text = path.read_text(encoding="utf-8")
    (step,) = {json.loads(found)["step"] for found in re.findall('class="about">(.*?)</script>', text)}
    assert step > 1
    assert f"C1: every {step} px" in text
    assert "coarser than could be, for all 8 states to be in one page of at most 1 MB" in text


def test_a_state_has_a_report_of_its_own(run: Run) -> None:
    long = campaign(states=4, virtual=False)
    subjects = list(report_state.KIND.subjects(long))
    assert [str(s) for s in subjects] == [f"plate/S0{i}" for i in (1, 2, 3)]
    ((output, path),) = run(report_state.KIND, long, subjects[1], figure_width_px=240, also="gauges")
    assert (output.filename, output.subject) == ("plate-S02-report.html", subjects[1])
    page = Checker.of(path.read_text(encoding="utf-8"))
    assert len(page.images) == 3 + 4
    words = " ".join(page.words)
    assert "State S02, 2469 N" in words
    assert "S01" not in words
    assert "S03" not in words
    # What a gauge read, 2,000 microstrain at this load, and another that read nothing.
    assert "2000 ± 2" in page.words
    assert "<G2> [µε]" in page.words


def test_states_are_left_out_and_the_page_says_which(run: Run) -> None:
    long = campaign(states=4, virtual=False)
    chosen = report.ReportParameters(leave_out="S01, S03,S01")
    # As the command line parts them.
    assert chosen == report.ReportParameters(leave_out=["S01", " S03", "S01", ""])
    assert chosen.leave_out == ("S01", "S03")
    needed = report.KIND.checked_needs(long, Subject("plate"), chosen)
    assert {need.subject.state for need in needed} == {None, "S00", "S02"}
    ((_, path),) = run(report.KIND, long, Subject("plate"), leave_out="S01,S03,S01")
    words = Checker.of(path.read_text(encoding="utf-8")).words
    assert "Left out, as was asked for: S01, S03." in words
    assert "State S02, 2469 N" in words
    assert [text for text in words if text.startswith(("State S01", "State S03"))] == []


@pytest.mark.parametrize(
    ("label", "why"),
    [("S9", "has no state S9"), ("S00", "S00 is the reference state: every report shows it")],
)
def test_what_cannot_be_left_out_is_refused(label: str, why: str) -> None:
    chosen = report.ReportParameters(leave_out=(label,))
    with pytest.raises(InvalidInput, match=why):
        report.KIND.checked_needs(campaign(states=4), Subject("plate"), chosen)


def test_only_what_is_known_can_be_shown_besides() -> None:
    with pytest.raises(ValidationError, match="has no extra 'moments'; choose among gauges"):
        report.ReportParameters(also=("moments",))
    assert report.ReportParameters(also="gauges").also == ("gauges",)


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
    ((_, path),) = run(export.KIND, campaign(), Subject("plate", "S02"), formats=("npz",))
    need = Port("", MEASUREMENT, ()).of(Subject("plate", "S00", "C1P1"))
    texture = records_for(need, (45, 60))["measurement"].texture
    with np.load(path) as found:
        # Full scale is 4095; single precision.
        row, column = [3, 3, 4], [5, 6, 5]
        np.testing.assert_allclose(found["texture"], texture[row, column] / 4095, rtol=2.0**-23)


def test_export_writes_a_file_for_each_camera_where_points_are_over_an_image(run: Run) -> None:
    two, seen = campaign(views=("C1P1", "C2P1")), {"mesh": mesh(("C1", "C2"))}
    documents = run(export.KIND, two, Subject("plate", "S01"), formats=("ptx", "e57", "xyz"), instead=seen)
    assert [path.name for _, path in documents] == [
        *("plate-S01-C1.ptx", "plate-S01-C2.ptx", "plate-S01-C1.e57", "plate-S01-C2.e57", "plate-S01.xyz")
    ]
    head = documents[0][1].read_text().splitlines()[:2]
    assert head == ["60", "45"]


def test_export_of_what_has_no_value_writes_nothing_and_says_so(run: Run) -> None:
    seen = mesh()
    nothing = replace(seen, faces=seen.faces[:0])
    heard: list[str] = []
    given = {"instead": {"mesh": nothing}, "heard": heard}
    assert run(export.KIND, campaign(), Subject("plate", "S01"), **given) == []
    assert heard[-1] == "note: nothing to export of plate-S01, where no square of pixels has values"


def test_export_writes_the_fields_that_are_asked_for(run: Run) -> None:
    chosen = ("displacement X",)
    ((_, path),) = run(export.KIND, campaign(), Subject("plate", "S01"), formats=("csv",), fields=chosen)
    assert path.read_text().splitlines()[0] == '"X [mm]","Y [mm]","Z [mm]","displacement X [mm]"'


def test_export_names_the_fields_that_there_are(run: Run) -> None:
    with pytest.raises(InvalidInput, match="has no field 'von_mises'; choose among displacement X"):
        run(export.KIND, campaign(), Subject("plate", "S02"), formats=("csv",), fields=("von_mises",))


def test_values_that_no_merged_surface_has_are_refused_before_it_is_there() -> None:
    with pytest.raises(InvalidInput, match="no value 'displacment Z'; did you mean 'displacement Z'; choose"):
        export.KIND.checked_parameters({"fields": "displacment Z"})
    deep = export.KIND.checked_parameters({"fields": ["von_mises", "displacement Z"]})
    subject = Subject("plate", "S01")
    assert list(export.needs(campaign(views=("C1P1",)), subject, deep))
    alone = replace(campaign(), views=("C1P1", "C2"))
    with pytest.raises(InvalidInput, match="'displacement Z', which the image of C2 alone does not have"):
        list(export.needs(alone, subject, deep))
