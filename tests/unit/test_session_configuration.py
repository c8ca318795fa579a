"""Calibration sessions in campaign files: the example can be measured, and nothing ill-posed is taken in."""

from __future__ import annotations

import re
from dataclasses import replace
from math import pi, radians

import numpy as np
import pytest
from support.true_boards import true_board

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.configuration import (
    CampaignPlan,
    example_campaign,
    example_session,
    parse_campaign,
)
from sms_jobs.kinds.recording.simulate import recipe
from sms_jobs.records.artefacts import BallBar, Chessboard, CircleBoard, DotCylinder, diameter_sigma_mm
from sms_jobs.records.scene import PanTilt, Rigid, Simulation
from sms_jobs.records.sensors import SensorFormat
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.artefact_truth import placed_points, true_bar

REAL = """
name = "calibration-7"
rig = "hall-3"
views = ["C1P1"]
specimen = { name = "chessboard 2" }

[session]
starts_from = "last-calibration"
sensors = [{ name = "P1", columns = 1024, rows = 768 }, { name = "C1", columns = 2048, rows = 2048 }]
artefacts.chess = { shape = "chessboard", columns = 9, rows = 6, pitch_mm = 25.0 }

[session.artefacts.bar]
shape = "ball-bar"
length_mm = 500
length_sigma_mm = 0.01
radius_mm = 25
radius_sigma_mm = 0.01

[[states]]
label = "B01"
artefact = "chess"

[[states]]
label = "S01"
artefact = "bar"
pan_deg = 22.5
tilt_deg = -45
channels = { temperature_c = 20.5 }
"""


def changed(old: str, new: str, text: str | None = None) -> CampaignPlan:
    """Parse the example after a change of its text."""
    text = example_session() if text is None else text
    assert old in text
    return parse_campaign(text.replace(old, new, 1), "session.toml")


def test_the_example_describes_a_session_whose_calibration_is_to_be_found() -> None:
    plan = parse_campaign(example_session(), "example")
    campaign, session = plan.campaign, plan.campaign.session
    assert plan.calibration is None
    assert session is not None
    assert campaign.scene is not None
    board, bar = session.artefacts["board"], session.artefacts["bar"]
    assert isinstance(board, CircleBoard)
    assert board.markers == ((1, 1), (5, 1), (1, 5))
    assert isinstance(bar, BallBar)
    assert bar.length_mm == 190.0
    assert campaign.scene.surface == board
    assert [s.label for s in campaign.states] == ["B01", "B02", "B03", *(f"S{n:02d}" for n in range(1, 7))]
    assert [s.artefact for s in campaign.states] == ["board"] * 3 + ["bar"] * 6
    assert campaign.views == ("C1P1", "C1P2")
    assert [s.name for s in session.sensors] == ["C1", "P1", "P2"]
    assert session.sensors[1] == SensorFormat("P1", 512, 384)
    # 180 and 40 degrees, to a few roundings.
    assert session.board_in_world.rotation_rad == pytest.approx((pi, 0.0, 0.0), rel=1e-15)
    assert campaign.states[4].channels == pytest.approx({"pan_rad": radians(40.0), "tilt_rad": 0.0})
    assert isinstance(campaign.states[4].deformation[0], PanTilt)


def test_the_example_can_be_measured() -> None:
    campaign = parse_campaign(example_session(), "example").campaign
    assert campaign.session is not None
    for state in campaign.states:
        task = recipe(campaign, Subject(campaign.name, state.label))
        for view in campaign.views:
            sim = Simulation(task.scene, *view_of(view).sensors, task.deformation, state.label)
            if state.artefact == "board":
                assert true_board(sim).seen.all()
            else:
                # More than half of a disc 33 px wide.
                assert true_bar(sim).seen_px.min() > 500
    first = campaign.states[0]
    points = np.array([[0.0, 0.0, 0.0], [10.0, 20.0, 5.0]])
    scene = recipe(campaign, Subject(campaign.name, "B01")).scene
    np.testing.assert_array_equal(
        placed_points(scene, first.deformation, points),
        placed_points(scene, (campaign.session.board_in_world,), points),
    )


def test_a_real_session_says_what_its_sensors_are() -> None:
    plan = parse_campaign(REAL, "real.toml")
    campaign, session = plan.campaign, plan.campaign.session
    assert plan.calibration is None
    assert campaign.scene is None
    assert session is not None
    assert session.sensors == (SensorFormat("C1", 2048, 2048), SensorFormat("P1", 1024, 768))
    assert session.starts_from == "last-calibration"
    assert session.board_in_world == Rigid()
    assert session.volume is None
    assert isinstance(session.artefacts["chess"], Chessboard)
    expected = {"pan_rad": radians(22.5), "tilt_rad": radians(-45.0), "temperature_c": 20.5}
    assert campaign.states[1].channels == expected


def test_a_stage_that_was_read_counts_more_than_what_it_was_told() -> None:
    read = changed(
        'label = "S02"\nartefact = "bar"\n',
        'label = "S02"\nartefact = "bar"\npan_deg = 40.1\ntilt_deg = 0.1\n',
    )
    assert read.campaign.states[4].channels["pan_rad"] == radians(40.1)
    read = changed(
        'label = "S02"\nartefact = "bar"\n', 'label = "S02"\nartefact = "bar"\nchannels = { pan_rad = 0.7 }\n'
    )
    assert read.campaign.states[4].channels == {"pan_rad": 0.7, "tilt_rad": 0.0}


def test_the_volume_of_the_scene_holds_where_the_session_has_none() -> None:
    plan = changed("[session.volume]", "[scene.volume]")
    assert plan.campaign.session is not None
    assert plan.campaign.session.volume is not None
    assert plan.campaign.session.volume.high == (130.0, 130.0, 130.0)


MISTAKES = [
    ('artefact = "bar"', "", "state S01 shows no artefact: in a calibration session every state names one"),
    (
        'artefact = "bar"',
        'artefact = "bra"',
        "state S01 shows the artefact bra, which campaign calibration-1",
    ),
    (
        'shape = "circle-board"',
        'shape = "circles"',
        "session.artefacts.board.shape should be one of 'circle-",
    ),
    ("pitch_mm = 30.0", "pitch_mm = 0", "session.artefacts.board.pitch_mm should be greater than 0, not 0"),
    ("columns = 7", "columns = 1", "session.artefacts.board.columns should be greater than or equal to 2"),
    ("columns = 7", "columns = 5", "the marker (5, 1) of board is not on its 5 x 7 dots"),
    ("[[1, 1], [5, 1], [1, 5]]", "[[1, 1], [5, 2], [1, 5]]", "the markers of board define no axes"),
    ("[[1, 1], [5, 1], [1, 5]]", "[[1, 1], [5, 1]]", "session.artefacts.board.markers[3] is missing"),
    ('marker = "ring"', 'marker = "star"', "session.artefacts.board.marker should be 'ring' or 'larger-dot'"),
    ("marker_hole_mm = 12.0", "", "the rings of board need marker_hole_mm between 0 and marker_diameter_mm"),
    ("dot_diameter_mm = 18.0", "dot_diameter_mm = 36.0", "the dots of board overlap: diameters of 36.0 and"),
    (
        'marker = "ring"                 # or "larger-dot"\nmarker_diameter_mm = 24.0',
        'marker = "larger-dot"\nmarker_diameter_mm = 18.0',
        "the markers of board, larger dots, need a marker_diameter_mm above the 18.0 mm",
    ),
    (
        "length_mm = 190.0",
        "length_mm = 40.0",
        "the spheres of bar, of radius 22.0 mm, touch at a length of 40.0",
    ),
    (
        "length_sigma_mm = 0.005",
        "length_sigma_mm = 0",
        "session.artefacts.bar.length_sigma_mm should be greater",
    ),
    ("length_sigma_mm = 0.005", "", "session.artefacts.bar.length_sigma_mm is missing"),
    (
        "[session.artefacts.bar]",
        '[session.artefacts."b/r"]',
        "'b/r' cannot be the name of a calibration artefact",
    ),
    (
        'starts_from = "nothing"',
        'starts_from = "scratch"',
        "session.starts_from should be 'nothing' or 'last-c",
    ),
    (
        "seed = 11",
        'surface = { shape = "plane", width_mm = 1, height_mm = 1 }',
        "scene.surface has no place in",
    ),
    ("seed = 11", "speckle = { diameter_mm = 2 }", "scene.speckle has no place in a calibration session"),
    (
        "seed = 11",
        "calibration_valid_from = 2026-01-01T00:00:00Z",
        "scene.calibration_valid_from has no place",
    ),
    (
        "pan_deg = 40, tilt_deg = 0 }",
        "pan_deg = 40, tilt_deg = 0 },\n    { motion = 'uniaxial-strain', strain = 0.1 }",
        "state S02 deforms bar by uniaxial-strain, but artefacts are stiff",
    ),
    (
        "[session.artefacts.board]",
        "[[session.sensors]]\nname = 'C1'\ncolumns = 9\nrows = 9\n[session.artefacts.board]",
        "session.sensors repeats what [[scene.sensors]] says",
    ),
]


@pytest.mark.parametrize(("old", "new", "message"), MISTAKES, ids=[m[2][:50] for m in MISTAKES])
def test_a_mistake_is_refused_by_file_key_and_expectation(old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        changed(old, new)
    assert re.match(r"session\.toml(, line \d+)?: ", str(refused.value))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


REAL_MISTAKES = [
    ('{ name = "P1", columns = 1024, rows = 768 }, ', "", "how many pixels P1 of view C1P1 has"),
    ('{ name = "P1"', '{ name = "C1"', "two sensors of the session have one name: C1, C1"),
    ("tilt_deg = -45", "", "states[S01] needs both of pan_deg and tilt_deg, or neither"),
    ("temperature_c = 20.5", "pan_rad = 0.3", "states[S01] gives the angles twice"),
    ('views = ["C1P1"]', "", "views is missing or empty"),
    (
        'artefact = "chess"',
        'artefact = "chess"\ndeformation = [{ motion = "rigid" }]',
        "state B01 has a deformation, but only what stands before a virtual rig",
    ),
    ("artefacts.chess", "artefact.chess", "session has no key 'artefact'; its keys are artefacts, sensors"),
]


@pytest.mark.parametrize(("old", "new", "message"), REAL_MISTAKES, ids=[m[2][:50] for m in REAL_MISTAKES])
def test_a_mistake_in_a_real_session_is_refused(old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        changed(old, new, REAL)
    assert message in str(refused.value)


def test_a_test_keeps_what_it_needs() -> None:
    text = example_campaign()
    volume, surface, speckle = (text.index(f"[scene.{part}]") for part in ("volume", "surface", "speckle"))
    with pytest.raises(ConfigurationError, match=r"scene\.surface is missing: describe what is"):
        parse_campaign(text[:surface] + text[speckle:], "plate.toml")
    with pytest.raises(ConfigurationError, match=r"scene\.volume is missing: give the corners"):
        parse_campaign(text[:volume] + text[surface:], "plate.toml")
    with pytest.raises(
        ConfigurationError, match="which campaign plate-tension does not describe; it describes none"
    ):
        changed('label = "S00"', 'label = "S00"\nartefact = "board"', text)
    with pytest.raises(ConfigurationError, match=r"session\.artefacts is missing"):
        parse_campaign(text + "\n[session]\n", "plate.toml")
    with pytest.raises(ConfigurationError, match=r"session\.artefacts is empty"):
        parse_campaign(text + "\n[session]\nartefacts = {}\n", "plate.toml")


def test_cameras_without_a_projector_look_at_boards_one_by_one() -> None:
    text = example_session().replace('"P1"', '"C2"').replace('"P2"', '"C3"')
    campaign = parse_campaign(text, "session.toml").campaign
    assert campaign.views == campaign.recordings == ("C1", "C2", "C3")
    assert campaign.session is not None
    assert [s.name for s in campaign.session.sensors] == ["C1", "C2", "C3"]
    task = recipe(campaign, Subject(campaign.name, "B02"))
    truth = true_board(Simulation.of(task.scene, view_of("C2"), task.deformation, "B02"))
    assert truth.seen.all()
    assert np.isfinite(truth.camera_px).all()
    assert np.isnan(truth.projector_px).all()
    bar = recipe(campaign, Subject(campaign.name, "S01"))
    spheres = true_bar(Simulation.of(bar.scene, view_of("C2"), bar.deformation, "S01"))
    assert spheres.seen_px.min() > 100
    assert np.isnan(spheres.projector_px).all()
    with pytest.raises(
        ConfigurationError, match=r"C1C2 has no place in a calibration session.*\['C1', 'C2'\]"
    ):
        parse_campaign('views = ["C1C2"]\n' + text, "session.toml")


CYLINDER = """
name = "tube-1"
rig = "ring"
views = ["C1", "C2"]
specimen = { name = "tube 1" }
session.sensors = [{ name = "C1", columns = 2048, rows = 2048 }, { name = "C2", columns = 2048, rows = 2048 }]

[session.artefacts.tube]
shape = "dot-cylinder"
columns = 40
rows = 13
pitch_mm = 6.0
dot_diameter_mm = 3.3
diameter_mm = 80.0
diameter_sigma_mm = 0.05
markers = [[8, 4], [12, 4], [8, 8], [28, 4], [33, 4], [28, 8]]
marker_diameter_mm = 4.2
marker_hole_mm = 1.8

[[states]]
label = "B01"
artefact = "tube"
"""


def test_a_cylinder_of_dots_is_an_artefact() -> None:
    session = parse_campaign(CYLINDER, "tube.toml").campaign.session
    assert session is not None
    tube = session.artefacts["tube"]
    assert isinstance(tube, DotCylinder)
    assert tube.markers == ((8, 4), (12, 4), (8, 8), (28, 4), (33, 4), (28, 8))
    assert diameter_sigma_mm(tube) == 0.05
    # 1/500 where nobody has told it.
    assert diameter_sigma_mm(replace(tube, diameter_sigma_mm=None)) == pytest.approx(0.16)


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("columns = 40", "columns = 43", "43 columns of tube at a pitch of 6 mm need 258 mm around"),
        ("pitch_mm = 6.0", "pitch_mm = 6.25", "are 1.21 pitches apart across the seam"),
        ("diameter_mm = 80.0", "diameter_mm = 30.0", "is more than 0.18 of its diameter"),
        ("rows = 13", "rows = 2", "needs three of both"),
        ("diameter_mm = 80.0", "diameter_mm = 0.0", "diameter_mm"),
        ("diameter_sigma_mm = 0.05", "diameter_sigma_mm = 0.0", "diameter_sigma_mm"),
        ("[12, 4]", "[12, 5]", "the markers of tube define no axes"),
        ("[28, 8]]", "[28, 13]]", "the marker (28, 13) of tube is not on its 40 x 13 dots"),
        ("[[8, 4], [12, 4], [8, 8], [28, 4], [33, 4], [28, 8]]", "[[8, 4], [12, 4]]", "has 2 markers"),
        ("markers = [[8, 4], [12, 4], [8, 8], [28, 4], [33, 4], [28, 8]]\n", "", "without markers nobody"),
    ],
)
def test_a_cylinder_that_cannot_be_is_refused(old: str, new: str, why: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(why)):
        changed(old, new, CYLINDER)
