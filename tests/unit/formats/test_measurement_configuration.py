"""Campaigns in XML are those in TOML, and what is wrong in them is named by element and line."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.configuration import example_campaign, load_campaign, parse_campaign
from sms_jobs.formats.measurement_configuration import parse_measurement_configuration

PAGE = Path(__file__).resolve().parents[3] / "docs" / "configuration.md"
EXAMPLE = PAGE.read_text(encoding="utf-8").partition("```xml\n")[2].partition("```")[0]


def refusal(text: str, folder: Path) -> str:
    path = folder / "plate.xml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError) as refused:
        load_campaign(path)
    return str(refused.value)


def line_of(words: str, text: str) -> int:
    return text[: text.index(words)].count("\n") + 1


def test_the_example_in_xml_is_the_example_in_toml(tmp_path: Path) -> None:
    path = tmp_path / "plate.XML"
    path.write_text(EXAMPLE, encoding="utf-8")
    found, wanted = load_campaign(path), parse_campaign(example_campaign(), "example")
    assert found.calibration == wanted.calibration
    assert found.campaign.states == wanted.campaign.states
    assert found.campaign.processing == wanted.campaign.processing
    # What the TOML file writes out and the XML file leaves at its default is the same too.
    assert found == wanted


def test_elements_go_to_their_places() -> None:
    text = """<sms>
  <filename><campaign type="text">7</campaign></filename>
  <hardware><rig>hall-3</rig><views type="list">C1P1 C2P2</views></hardware>
  <acquisition><densities>fdr-64</densities><orientations_deg type="list">45</orientations_deg></acquisition>
  <phase_analysis><steps>5</steps><method>fourier</method><window type="bool">true</window></phase_analysis>
  <dic><subset_radius_px>8</subset_radius_px><minimum_score>0.9</minimum_score></dic>
  <processing><merge><weights type="list">a b</weights></merge></processing>
  <calibration><valid_from>2026-05-04T10:00:00+02:00</valid_from></calibration>
  <session><matrix type="list"><row>1 0</row><row>0, 1</row></matrix><nothing type="table"/></session>
</sms>"""
    content, places = parse_measurement_configuration(text, "hall.xml")
    moment = datetime(2026, 5, 4, 8, tzinfo=UTC)
    assert content == {
        "name": "7",
        "rig": "hall-3",
        "views": ["C1P1", "C2P2"],
        "sequence": {"densities": "fdr-64", "orientations_deg": [45], "steps": 5},
        "processing": {
            "reconstruct": {"method": "fourier", "window": True},
            "correlate": {"subset_radius_px": 8, "minimum_score": 0.9},
            "merge": {"weights": ["a", "b"]},
        },
        "scene": {"calibration_valid_from": moment},
        "session": {"matrix": [[1, 0], [0, 1]], "nothing": {}},
    }
    assert (
        places.at(("processing", "correlate", "minimum_score"))
        == "hall.xml, line 6, element sms/dic/minimum_score"
    )
    assert places.at(("session", "matrix", 1, 0)) == "hall.xml, line 9, element sms/session/matrix/row[2]"
    assert places.at(("specimen",)) == "hall.xml, line 1, element sms"


def test_activated_sensors_are_named_by_their_indices() -> None:
    text = "<sms><hardware><cameras>1 3</cameras><projectors>2</projectors></hardware></sms>"
    assert parse_measurement_configuration(text, "x")[0]["views"] == ["C1P2", "C3P2"]


MISTAKES = [
    ("<steps>4</steps>", "<steps>2</steps>", "at least 3 phase steps, not 2", None),
    (
        "<steps>4</steps>",
        "<steps>many</steps>",
        "sequence.steps should be a whole number, not 'many'",
        "phase_analysis/steps",
    ),
    (
        "<fx>1900</fx>",
        "<fx>-1</fx>",
        "scene.sensors[P1].fx should be greater than or equal to 1",
        "calibration/sensors/sensor[3]/fx",
    ),
    (
        "<strain>0.0011428</strain>",
        "",
        "states[S02].deformation[1].strain is missing",
        "acquisition/states/state[3]/deformation/step[1]",
    ),
    (
        "<shape>plane</shape>",
        "<shape>plain</shape>",
        "scene.surface.shape should be one of 'plane'",
        "hardware/scene/surface",
    ),
    ("<rig>virtual-plate</rig>", "", "rig is missing", ""),
    ("<rig>virtual-plate</rig>", "<rig>a</rig><rig>b</rig>", "stands here twice", "hardware/rig"),
    (
        "<seed>7</seed>",
        "<seed>7</seed><seed>8</seed>",
        "stands here twice; a list needs type",
        "hardware/scene/seed",
    ),
    ("<seed>7</seed>", '<seed unit="1">7</seed>', "has no attribute 'unit'", "hardware/scene/seed"),
    (
        "<seed>7</seed>",
        '<seed type="double">7</seed>',
        "type should be one of int, float",
        "hardware/scene/seed",
    ),
    ("<seed>7</seed>", '<seed type="int">x</seed>', "should be of type int, not 'x'", "hardware/scene/seed"),
    ("<seed>7</seed>", "<seed>7<a/></seed>", "holds '7' beside other elements", "hardware/scene/seed"),
    (
        "<cameras>1 2</cameras>",
        "<cameras>one</cameras>",
        "should hold the indices of cameras",
        "hardware/cameras",
    ),
    ("<cameras>1 2</cameras>", "", "needs either cameras and projectors, or views", "hardware"),
    (
        "<cameras>1 2</cameras>",
        "<lasers>1</lasers>",
        "hardware has no such element; its elements are rig",
        "hardware/lasers",
    ),
    ("<cameras>1 2</cameras>", "<cameras>1 4</cameras>", "rig virtual-plate has no sensor C4", None),
    ("<specimen>", "<specimen/><specimen>", "stands here twice", "specimen"),
    (
        "<strain><gauge",
        "<lidar/><strain><gauge",
        "sms has no element lidar; its elements are acquisition",
        "lidar",
    ),
    ("<sms>", "<sms><processing>3</processing>", "holds other elements alone", "processing"),
]


@pytest.mark.parametrize(("old", "new", "message", "element"), MISTAKES, ids=[m[2][:45] for m in MISTAKES])
def test_a_mistake_is_named_by_element_and_line(
    old: str, new: str, message: str, element: str | None, tmp_path: Path
) -> None:
    assert old in EXAMPLE
    said = refusal(EXAMPLE.replace(old, new, 1), tmp_path)
    assert said.startswith(str(tmp_path / "plate.xml"))
    assert message in said
    name = None if element is None else f"sms/{element}".rstrip("/")
    assert name is None or f", element {name}: " in said
    assert "\n" not in said


def test_the_line_is_that_of_the_element(tmp_path: Path) -> None:
    text = EXAMPLE.replace("<fx>1900</fx>", "<fx>0</fx>")
    assert f"plate.xml, line {line_of('<fx>0</fx>', text)}, element" in refusal(text, tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: this is not well-formed XML (no element found)"),
        ("<sms>", "this is not well-formed XML"),
        ("<campaign/>", "should begin with the element <sms>, not <campaign>"),
        (
            "<!DOCTYPE sms [<!ENTITY a 'b'>]><sms>&a;</sms>",
            "a document type declaration (<!DOCTYPE ...>) is not read",
        ),
        ("<!DOCTYPE sms SYSTEM 'file:///etc/passwd'><sms/>", "a document type declaration"),
        ("<sms>&a;</sms>", "undefined entity"),
        ("<sms>" + "<session>" * 40, "there are more than 24 levels"),
        ("name = 'plate'", "this is not well-formed XML"),
    ],
    ids=["empty", "open", "root", "entity", "outside", "undefined", "deep", "toml"],
)
def test_what_is_no_such_file_is_refused(text: str, message: str, tmp_path: Path) -> None:
    assert message in refusal(text, tmp_path)
