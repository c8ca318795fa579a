"""Campaign files: the example is valid, units are converted once, and nothing wrong is taken in."""

from __future__ import annotations

import tomllib
from dataclasses import fields
from datetime import UTC, datetime
from math import pi
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from sms_jobs.errors import ConfigurationError, NotFound
from sms_jobs.formats.configuration import (
    CampaignPlan,
    example_campaign,
    example_session,
    example_stereo,
    load_campaign,
    parse_campaign,
)
from sms_jobs.formats.interchange.text_files import LARGEST_FILE_BYTES
from sms_jobs.formats.record_tables import table_of
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.records.scene import (
    CameraResponse,
    Deformation,
    Plane,
    ProjectorResponse,
    Rigid,
    Simulation,
    Speckle,
    StiffenedPanel,
    Stud,
    Surface,
    TieRod,
    UniaxialStrain,
)
from sms_jobs.records.views import Role, view_of
from sms_jobs.virtual_rig.truth import exact_shape

REAL = """
name = "wing"
rig = "hall-3"
views = ["C1P1"]
specimen = { name = "wing panel" }
states = [{ label = "S00" }]
"""


def changed(old: str, new: str) -> CampaignPlan:
    """Parse the example after a change of its text."""
    text = example_campaign()
    assert old in text
    return parse_campaign(text.replace(old, new, 1), "plate.toml")


def test_the_example_is_read_as_it_is_written() -> None:
    plan = parse_campaign(example_campaign(), "example")
    campaign = plan.campaign
    assert (campaign.name, campaign.rig, campaign.views) == (
        "plate-tension",
        "virtual-plate",
        ("C1P1", "C2P1"),
    )
    assert [s.load_n for s in campaign.states] == [0.0, 20_000.0, 40_000.0]
    assert campaign.states[1].channels == {"gauge_1": 0.00057}
    assert campaign.scene is not None
    assert campaign.scene.surface == Plane(300.0, 240.0)
    assert campaign.scene.camera.blur_px == 0.5
    strain, motion = campaign.states[2].deformation
    assert strain == UniaxialStrain(0.0011428, 0.33)
    assert isinstance(motion, Rigid)
    # 0.2 degrees; the tolerance is a few roundings.
    assert motion.rotation_rad == pytest.approx((0.0, 0.2 * pi / 180.0, 0.0), rel=1e-15)
    assert campaign.sequence.orientations_rad == pytest.approx((0.0, pi / 2), rel=1e-15)


def test_the_calibration_of_a_virtual_rig_is_its_exact_parameters() -> None:
    plan = parse_campaign(example_campaign(), "example")
    calibration = plan.calibration
    assert calibration is not None
    assert plan.campaign.scene is not None
    assert calibration.rig.sensors == plan.campaign.scene.rig.sensors
    assert calibration.rig.name == plan.campaign.rig
    assert [s.role for s in calibration.rig.sensors] == [Role.CAMERA, Role.CAMERA, Role.PROJECTOR]
    assert calibration.valid_from <= datetime(2000, 1, 1, tzinfo=UTC)


def test_every_sensor_of_the_example_sees_the_whole_plate() -> None:
    plan = parse_campaign(example_campaign(), "example")
    assert plan.calibration is not None
    corners = np.array([(x, y, 0.0) for x in (-150.0, 150.0) for y in (-120.0, 120.0)])
    for sensor in plan.calibration.rig.sensors:
        pixels = project(sensor.intrinsics, sensor.pose, corners)
        assert (pixels > 0.0).all(), sensor.name
        assert (pixels < [sensor.columns - 1, sensor.rows - 1]).all(), sensor.name
        # And the plate fills at least 40 % of the image's width: no pixels are wasted on the background.
        assert np.ptp(pixels[:, 0]) > 0.4 * sensor.columns


def test_a_pose_can_be_given_by_what_is_looked_at_or_by_its_matrix() -> None:
    looking = parse_campaign(example_campaign(), "example").calibration
    assert looking is not None
    pose = looking.rig.sensor("P1").pose
    matrix = [list(row) for row in pose.rotation]
    given = changed(
        "position_mm = [0.0, -40.0, 1000.0]\ntarget_mm = [0.0, 0.0, 0.0]",
        f"rotation = {matrix}\ntranslation_mm = {list(pose.translation)}",
    ).calibration
    assert given is not None
    assert given.rig.sensor("P1") == looking.rig.sensor("P1")


def test_a_volume_that_no_sensor_of_the_scene_sees_is_refused() -> None:
    corners = "low_mm = [-170.0, -140.0, -60.0]\nhigh_mm = [170.0, 140.0, 60.0]"
    far = "low_mm = [-170.0, -140.0, 2000.0]\nhigh_mm = [170.0, 140.0, 2060.0]"
    with pytest.raises(ConfigurationError, match="no sensor of the scene sees anything of the volume"):
        changed(corners, far)


def test_a_placement_turns_by_degrees() -> None:
    plan = changed("[scene.volume]", "[scene.placement]\nrotation_deg = [0, 0, 90]\n\n[scene.volume]")
    assert plan.campaign.scene is not None
    # A quarter turn about z brings x to y; the tolerance is rounding.
    turned = plan.campaign.scene.placement.matrix() @ [1.0, 0.0, 0.0]
    np.testing.assert_allclose(turned, [0.0, 1.0, 0.0], atol=1e-15)


def test_every_pair_of_a_virtual_rig_measures_unless_some_are_named() -> None:
    assert changed('views = ["C1P1", "C2P1"]', "").campaign.views == ("C1P1", "C2P1")
    assert changed('views = ["C1P1", "C2P1"]', 'views = ["C2P1"]').campaign.views == ("C2P1",)


def test_a_real_rig_has_no_scene_and_is_calibrated_by_measurement() -> None:
    plan = parse_campaign(REAL, "wing.toml")
    assert plan.calibration is None
    assert plan.campaign.scene is None
    assert len(plan.campaign.sequence.densities) == 6
    with pytest.raises(ConfigurationError, match="views is missing or empty"):
        parse_campaign(REAL.replace('views = ["C1P1"]', ""), "wing.toml")
    with pytest.raises(ConfigurationError, match=r"described under \[scene\]"):
        parse_campaign(
            REAL.replace('"S00"', '"S00", deformation = [{ motion = "halves-apart", gap_mm = 1 }]'),
            "wing.toml",
        )


def test_a_sequence_has_as_many_exposures_as_are_given() -> None:
    text = REAL + "\n[sequence]\nexposures = [0.25, 1, 4.0]\n"
    sequence = parse_campaign(text, "wing.toml").campaign.sequence
    assert sequence.exposures == (0.25, 1.0, 4.0)
    assert sequence.frames == 3 * sequence.frames_per_exposure == 3 * len(list(sequence.patterns()))
    for wrong, said in (("[]", "one exposure or several"), ("[1, -1]", "above 0"), ("[2, 2]", "once")):
        with pytest.raises(ConfigurationError, match=said):
            parse_campaign(text.replace("[0.25, 1, 4.0]", wrong), "wing.toml")


def test_a_sequence_can_be_named() -> None:
    text = REAL + '\n[sequence]\ndensities = "fdr-64"\norientations_deg = [45, -45]\n'
    sequence = parse_campaign(text, "wing.toml").campaign.sequence
    assert sequence.densities == tuple(range(64))
    assert sequence.frames == 2 * (4 * 64 - 2)  # thesis section 7.2.2
    steps = [(t, k) for _, t, k in sequence.patterns()][:7]
    assert steps == [(0, 0), (0, 2), (1, 0), (1, 1), (1, 2), (1, 3), (2, 0)]


MISTAKES = [
    (
        "densities = [32, 31, 30, 28, 24, 16]",
        'densities = "gray-code"',
        "sequence.densities is unknown: there is no fringe sequence 'gray-code'",
    ),
    ("densities = [32, 31, 30, 28, 24, 16]", "densities = [0]", "fringe densities must be at least 1, or 0"),
    ("densities = [32, 31, 30, 28, 24, 16]", "densities = [0, 0, 1]", "shown once at most"),
    ("width_mm = 300.0", 'width_mm = "wide"', "scene.surface.width_mm should be a number, not 'wide'"),
    ("width_mm = 300.0", "width_mm = -300", "scene.surface.width_mm should be greater than 0, not -300"),
    ("width_mm", "widht_mm", "scene.surface has no key 'widht_mm'; its keys are width_mm, height_mm, shape"),
    ('shape = "plane"', 'shape = "plain"', "scene.surface.shape should be one of 'plane', 'cylinder'"),
    ('shape = "plane"', "", "scene.surface.shape is missing"),
    ("load_n = 40_000", "load_n = true", "states[S02].load_n should be a number, not True"),
    ("load_n = 40_000", "load_kn = 40", "states[S02] has no key 'load_kn'"),
    ("load_n = 40_000", "time = 2026-01-01T00:00:00", "states[S02].time needs a time zone"),
    ('label = "S02"', "", "states[3].label is missing"),
    ('label = "S02"', 'label = "S01"', "two states of one label"),
    ('label = "S02"', 'label = "a/b"', "'a/b' cannot be the name of a state"),
    ('name = "plate-tension"', 'name = "../etc"', "'../etc' cannot be the name of a campaign"),
    ("channels = { gauge_1 = 0.00114 }", "channels = 3", "states[S02].channels should be a table, not 3"),
    ("strain = 0.0011428", "strain = nan", "states[S02].deformation[1].strain should be a finite number"),
    ("gamma = 1.0", "gamma = 0", "scene.projector.gamma should be greater than 0, not 0"),
    ("bits = 12", "bits = 10", "scene.camera.bits should be 8, 12 or 16, not 10"),
    ("columns = 800", "columns = 800.5", "scene.sensors[P1].columns should be a whole number, not 800.5"),
    ("columns = 800", "columns = 800_000", "scene.sensors[P1].columns should be less than or equal to 20000"),
    ('name = "P1"', 'name = "Q1"', "scene.sensors[Q1].name should be C1, C2, ... for a camera"),
    ('name = "P1"', 'name = "C2"', "two sensors of the scene have one name: C1, C2, C2"),
    ('"C2P1"', '"C3P1"', "rig virtual-plate has no sensor C3; it has C1, C2, P1"),
    ('"C2P1"', '"C1P1"', "views names one view twice"),
    ('"C2P1"', '"P1C2"', "'P1C2' is not a view"),
    ("position_mm = [0.0, -40.0, 1000.0]", "", "scene.sensors[P1] needs either position_mm and target_mm"),
    ("[0.0, -40.0, 1000.0]", "[0.0, 5.0, 0.0]", "sensor P1 cannot look along [0.0, -5.0, 0.0] mm"),
    (
        "position_mm = [0.0, -40.0, 1000.0]\ntarget_mm = [0.0, 0.0, 0.0]",
        "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]\ntranslation_mm = [0, 0, 1]",
        "sensor P1 has a rotation that is no right-handed rotation matrix",
    ),
    ("strain = 0.0005714", "strain = -1.2", "states[S01].deformation[1] cannot be: strain = -1.2 turns"),
    ("low_mm = [-170.0", "low_mm = [170.0", "scene.volume needs every coordinate of low_mm below"),
    ("low_mm = [-170.0", "low_mm = [0, -170.0", "scene.volume.low_mm should have at most 3 items, not 4"),
    ("steps = 4", "steps = 2", "at least 3 phase steps, not 2"),
    ("[specimen]", "[[specimen]]", "specimen should be a table"),
    ("[scene.camera]", "[camera]", "the file has no key 'camera'"),
    ("seed = 7", "seed = ", "is not valid TOML: Invalid value (at line 51"),
]


@pytest.mark.parametrize(("old", "new", "message"), MISTAKES, ids=[m[2][:50] for m in MISTAKES])
def test_a_mistake_is_refused_by_file_key_and_expectation(old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        changed(old, new)
    assert str(refused.value).startswith("plate.toml")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_campaign_needs_a_state_a_camera_and_a_projector() -> None:
    with pytest.raises(ConfigurationError, match="campaign wing has no state"):
        parse_campaign(REAL.replace('{ label = "S00" }', ""), "wing.toml")
    scene = example_campaign().partition("[[scene.sensors]]")[0].replace("[scene]", "[scene]\nsensors = []")
    with pytest.raises(ConfigurationError, match="at least one camera and one projector"):
        parse_campaign(scene, "plate.toml")


def test_several_mistakes_are_counted() -> None:
    with pytest.raises(ConfigurationError, match=r"\(and 1 more\)"):
        parse_campaign(example_campaign().replace("fx = 1800.0", "fx = 0"), "plate.toml")


@pytest.mark.parametrize(
    "record",
    [*get_args(Surface), *get_args(Deformation), Speckle, CameraResponse, ProjectorResponse],
    ids=lambda record: record.__name__,
)
def test_every_kind_of_scene_can_be_written(record: type) -> None:
    keys = {name.replace("_deg", "_rad") for name in table_of(record).model_fields}
    assert keys == {f.name for f in fields(record)}


def test_every_surface_and_motion_is_known_by_its_name() -> None:
    for surface in get_args(Surface):
        with pytest.raises(ConfigurationError) as refused:
            changed('shape = "plane"', f'shape = "{surface.shape}"\nno_such_key = 1')
        assert "scene.surface has no key 'no_such_key'" in str(refused.value)
    for motion in get_args(Deformation):
        with pytest.raises(ConfigurationError) as refused:
            changed('motion = "rigid"', f'motion = "{motion.motion}", no_such_key = 1')
        assert "states[S01].deformation[2] has no key 'no_such_key'" in str(refused.value)


def test_what_stands_on_a_panel_is_written_as_tables_in_its_table() -> None:
    old = 'shape = "plane"                         # or cylinder, sphere, plate-with-hole-and-step, top-hat, '
    old += "plate-and-mirror\nwidth_mm = 300.0\nheight_mm = 240.0\n"
    new = """shape = "stiffened-panel"
width_mm = 300.0
height_mm = 240.0
foot_width_mm = 80.0
foot_thickness_mm = 5.0
web_height_mm = 30.0
web_thickness_mm = 8.0
studs = [{ centre_mm = [10.0, 20.0], level_mm = 5.0, radius_mm = 6.0, height_mm = 8.0 }]
rod = { x_mm = 100.0, z_mm = 70.0, radius_mm = 6.0, length_mm = 280.0 }
"""
    scene = changed(old, new).campaign.scene
    assert scene is not None
    assert scene.surface == StiffenedPanel(
        300.0,
        240.0,
        80.0,
        5.0,
        30.0,
        8.0,
        (Stud((10.0, 20.0), 5.0, 6.0, 8.0),),
        TieRod(100.0, 70.0, 6.0, 280.0),
    )
    bare = changed(old, "\n".join(new.splitlines()[:-2]) + "\n").campaign.scene
    assert bare is not None
    assert bare.surface == StiffenedPanel(300.0, 240.0, 80.0, 5.0, 30.0, 8.0)
    with pytest.raises(ConfigurationError, match="radius_mm"):
        changed(old, new.replace("radius_mm = 6.0, length", "radius_mm = 0.0, length"))


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    path = tmp_path / "plate.toml"
    with pytest.raises(NotFound, match=r"plate\.toml"):
        load_campaign(path)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_campaign(tmp_path)
    path.write_bytes(b"name = '\xff'")
    with pytest.raises(ConfigurationError, match="not UTF-8 text"):
        load_campaign(path)
    path.write_bytes(b"#" * (LARGEST_FILE_BYTES + 1))
    with pytest.raises(ConfigurationError, match="larger than the 1048576 bytes"):
        load_campaign(path)
    path.write_text("a = " + "[" * 100_000, encoding="utf-8")
    with pytest.raises(ConfigurationError, match="not valid TOML"):
        load_campaign(path)
    path.write_text(example_campaign(), encoding="utf-8")
    assert load_campaign(path) == parse_campaign(example_campaign(), "example")


def test_every_line_of_the_example_is_needed_or_a_default() -> None:
    # The example must not drift from the tables: what it shows as a default is one.
    camera = tomllib.loads(example_campaign())["scene"]["camera"]
    assert CameraResponse(**camera) == CameraResponse()


def test_a_mistake_is_refused_by_its_line() -> None:
    text = example_campaign()
    lines = text.splitlines()
    wrong = next(i for i, line in enumerate(lines) if line.startswith("load_n"))
    second = next(i for i, line in enumerate(lines) if i > wrong and line.startswith("load_n"))
    lines[second] = 'load_n = "much"'
    with pytest.raises(ConfigurationError, match=rf"^plate\.toml, line {second + 1}: states\["):
        parse_campaign("\n".join(lines), "plate.toml")


def stereo(old: str, new: str) -> CampaignPlan:
    text = example_stereo()
    assert old in text
    return parse_campaign(text.replace(old, new), "panel.toml")


SECOND = example_stereo().rpartition("[[scene.sensors]]")[2]
THIRD = SECOND.replace('"C2"', '"C3"').replace("[86.8, 10.0, 492.4]", "[0.0, 100.0, 492.4]")


def test_the_stereo_example_is_measured_in_the_volume_by_two_cameras_and_no_projector() -> None:
    plan = parse_campaign(example_stereo(), "panel.toml")
    scene, calibration = plan.campaign.scene, plan.calibration
    assert scene is not None
    assert calibration is not None
    assert calibration.rig == scene.rig
    assert plan.campaign.views == scene.rig.views() == ("C1C2",)
    assert plan.campaign.recordings == ("C1", "C2")
    centres = np.array([s.pose.centre() for s in scene.rig.sensors])
    distance = np.linalg.norm(centres, axis=1)
    # Written to a tenth of a millimetre.
    np.testing.assert_allclose(distance, 500.0, atol=0.2)
    assert np.degrees(np.arccos(centres[0] @ centres[1] / distance.prod())) == pytest.approx(20.1, abs=0.1)
    low, high = (np.array(corner)[:, None] for corner in (calibration.volume.low, calibration.volume.high))
    for state in plan.campaign.states:
        shape = exact_shape(Simulation.of(scene, view_of("C1"), state.deformation, state.label), ("C2",))
        points = shape.xyz[:, shape.lit]
        assert ((points > low) & (points < high)).all()
        assert shape.lit.mean() > 0.35
        assert not shape.seen[[0, -1]].any()
        assert not shape.seen[:, [0, -1]].any()


def test_cameras_without_a_projector_measure_by_pairs_unless_some_are_named() -> None:
    three = example_stereo() + "\n[[scene.sensors]]" + THIRD
    named = parse_campaign(three, "panel.toml")
    assert named.campaign.views == ("C1C2",)
    every = parse_campaign(three.replace('views = ["C1C2"]', ""), "panel.toml")
    assert every.campaign.views == ("C1C2", "C1C3", "C2C3")
    assert stereo('["C1C2"]', '["C2C1", "C1"]').campaign.views == ("C2C1", "C1")
    with pytest.raises(ConfigurationError, match="rig virtual-stereo has no sensor C3; it has C1, C2"):
        stereo('["C1C2"]', '["C1C3"]')
    with pytest.raises(ConfigurationError, match="rig virtual-stereo has no sensor P1"):
        stereo('["C1C2"]', '["C1P1"]')
    lone = example_stereo().rpartition("[[scene.sensors]]")[0]
    assert parse_campaign(lone.replace('["C1C2"]', '["C1"]'), "panel.toml").campaign.views == ("C1",)
    with pytest.raises(ConfigurationError, match="or two cameras"):
        parse_campaign(lone.replace('views = ["C1C2"]', ""), "panel.toml")


def test_sensors_at_one_point_that_would_measure_together_are_refused() -> None:
    camera, projector = "position_mm = [-350.0, 60.0, 1000.0]", "position_mm = [0.0, -40.0, 1000.0]"
    with pytest.raises(ConfigurationError, match=r"C1 and P1 stand at one point in the scene, 0 mm apart"):
        changed(projector, camera)
    with pytest.raises(ConfigurationError, match=r"1e-07 mm apart \(at least 0.001 mm are needed\)"):
        changed(projector, camera.replace("1000.0", "1000.0000001"))
    assert changed(projector, camera.replace("1000.0", "1000.002")).calibration is not None
    # Two cameras at one point measure well, each with the projector.
    assert changed("[350.0, 60.0, 1000.0]", "[-350.0, 60.0, 1000.0]").campaign.views == ("C1P1", "C2P1")
    with pytest.raises(ConfigurationError, match="C1 and C2 stand at one point in the scene"):
        stereo("[86.8, 10.0, 492.4]", "[-86.8, -10.0, 492.4]")
    in_one_place = example_stereo().replace("[86.8, 10.0, 492.4]", "[-86.8, -10.0, 492.4]")
    alone = parse_campaign(in_one_place.replace('["C1C2"]', '["C1", "C2"]'), "panel.toml")
    assert alone.campaign.cameras_alone == ("C1", "C2")


def test_cameras_at_one_point_are_no_pair_that_a_session_could_calibrate() -> None:
    head, *sensors = example_session().split("[[scene.sensors]]")
    cameras = [head, sensors[0], sensors[0].replace("C1", "C2")]
    text = "[[scene.sensors]]".join(cameras)
    with pytest.raises(ConfigurationError, match="C1 and C2 stand at one point in the scene"):
        parse_campaign(text, "session.toml")


def test_a_lamp_stands_in_the_middle_unless_it_is_placed() -> None:
    assert stereo("seed = 5", "seed = 6").campaign.scene.lamp_mm is None  # type: ignore[union-attr]
    placed = stereo("seed = 5", "lamp_mm = [0, 300, 400]").campaign.scene
    assert placed is not None
    assert placed.lamp_mm == (0.0, 300.0, 400.0)
