"""Calibration sessions: poses well seen, the volume filled, angles and times as a calibration needs them."""

from __future__ import annotations

import numpy as np
import pytest
from support.sessions import on_site_session, small_session
from support.true_boards import TrueBoard, true_board

from sms_jobs.kinds.recording.simulate import recipe
from sms_jobs.records.artefacts import BallBar, CircleBoard
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.scene import PanTilt, Simulation
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.artefact_truth import placed_points, true_bar
from sms_jobs.virtual_rig.artefacts import bar_centres
from sms_jobs.virtual_rig.campaigns import START, top_hat_bending
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.sessions import calibration_session

FULL = calibration_session("calibration", "small")
SITE = on_site_session("on-site", "small")
SMALL = small_session("small")
SESSIONS = pytest.mark.parametrize("campaign", [FULL, SITE, SMALL], ids=lambda c: c.name)


def simulations(campaign: Campaign, artefact: str, views: tuple[str, ...] = ()) -> list[Simulation]:
    found = []
    for state in campaign.states:
        if state.artefact == artefact:
            task = recipe(campaign, Subject(campaign.name, state.label))
            found += [
                Simulation(task.scene, *view_of(view).sensors, task.deformation, state.label)
                for view in views or campaign.views
            ]
    return found


def dot_sizes(truth: TrueBoard, board: CircleBoard) -> np.ndarray:
    """Return the smaller axis of each dot's image, in px, from the spacing of its neighbours."""
    grid = truth.camera_px.reshape(board.rows, board.columns, 2)
    sides = np.stack([np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]], axis=-1)
    sizes = np.linalg.svd(sides, compute_uv=False)[..., 1]
    return np.asarray(sizes * board.dot_diameter_mm / board.pitch_mm)


@SESSIONS
def test_every_dot_is_seen_whole_by_every_sensor(campaign: Campaign) -> None:
    for sim in simulations(campaign, "board"):
        truth, board = true_board(sim), sim.scene.surface
        assert isinstance(board, CircleBoard)
        assert truth.seen.all()
        for pixels, name in ((truth.camera_px, sim.camera), (truth.projector_px, sim.projector)):
            sensor = sim.scene.rig.sensor(name)
            margin = np.minimum(pixels, [sensor.columns - 1, sensor.rows - 1] - pixels)
            assert margin.min() > 15.0
        # Even where the board is seen most obliquely.
        assert dot_sizes(truth, board).min() > 6.5


@pytest.mark.parametrize("campaign", [FULL, SMALL], ids=lambda c: c.name)
def test_both_spheres_are_seen_by_every_pair(campaign: Campaign) -> None:
    # More than half of a disc 30 px wide: what the projector at the side lights of a sphere.
    for sim in simulations(campaign, "bar")[:: 7 if campaign is FULL else 1]:
        assert true_bar(sim).seen_px.min() > 500
    for sim in simulations(campaign, "bar"):
        bar = sim.scene.surface
        assert isinstance(bar, BallBar)
        centres = placed_points(sim.scene, sim.deformation, bar_centres(bar))
        camera = sim.scene.rig.sensor(sim.camera)
        depth = np.linalg.norm(centres - camera.pose.centre(), axis=1)
        assert (2.0 * bar.radius_mm * camera.intrinsics.fx / depth).min() > 30.0


@SESSIONS
def test_the_poses_fill_the_volume_and_stay_inside(campaign: Campaign) -> None:
    assert campaign.session is not None
    assert campaign.session.volume is not None
    points = [true_board(sim).world for sim in simulations(campaign, "board", campaign.views[:1])]
    for sim in simulations(campaign, "bar", campaign.views[:1]):
        assert isinstance(sim.scene.surface, BallBar)
        points.append(placed_points(sim.scene, sim.deformation, bar_centres(sim.scene.surface)))
    cloud = np.concatenate(points)
    low, high = np.array(campaign.session.volume.low), np.array(campaign.session.volume.high)
    assert (cloud > low).all()
    assert (cloud < high).all()
    # Two thirds of it along every axis.
    assert (np.ptp(cloud, axis=0) > 0.66 * (high - low)).all()


@SESSIONS
def test_the_first_board_tells_where_the_world_is(campaign: Campaign) -> None:
    assert campaign.session is not None
    first = simulations(campaign, "board", campaign.views[:1])[0]
    assert first.state == campaign.states[0].label == "B01"
    points = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 5.0]])
    told = placed_points(first.scene, (campaign.session.board_in_world,), points)
    # A few roundings of numbers up to 200 mm.
    np.testing.assert_allclose(placed_points(first.scene, first.deformation, points), told, atol=1e-12)
    np.testing.assert_allclose(true_board(first).world.mean(axis=0), 0.0, atol=1e-12)


def test_the_bar_takes_the_poses_of_table_3() -> None:
    bars = [s for s in FULL.states if s.artefact == "bar"]
    assert [s.label for s in bars] == [f"S{n:02d}" for n in range(1, 26)]
    degrees = [(np.degrees(s.channels["pan_rad"]) % 360.0, np.degrees(s.channels["tilt_rad"])) for s in bars]
    expected = {1: (315, -45), 5: (45, -45), 6: (45, -22.5), 8: (0, -22.5), 10: (315, -22.5), 11: (315, 0)}
    expected |= {13: (0, 0), 14: (22.5, 0), 16: (45, 22.5), 20: (315, 22.5), 21: (315, 45), 25: (45, 45)}
    for number, angles in expected.items():
        assert degrees[number - 1] == pytest.approx(angles, abs=1e-12)
    assert len(set(degrees)) == 25
    for state in bars:
        stage = state.deformation[0]
        assert isinstance(stage, PanTilt)
        assert (stage.pan_rad, stage.tilt_rad) == tuple(state.channels.values())
    # One tripod for all.
    assert len({s.deformation[1] for s in bars}) == 1


@SESSIONS
def test_a_session_comes_before_the_tests_that_it_serves(campaign: Campaign) -> None:
    assert campaign.session is not None
    times = [s.time for s in campaign.states]
    assert times == sorted(times, key=str)
    assert all(time is not None and time < START for time in times)
    assert campaign.session.starts_from == ("last-calibration" if campaign is SITE else "nothing")


def test_it_is_the_rig_of_the_top_hat() -> None:
    calibration, hat = top_hat_bending("hat", "small")
    assert FULL.scene is not None
    assert hat.scene is not None
    assert FULL.session is not None
    assert FULL.rig == hat.rig
    assert FULL.scene.rig == calibration.rig == hat.scene.rig
    assert FULL.scene.projector == hat.scene.projector
    assert FULL.session.volume == calibration.volume
    assert [(s.name, s.columns, s.rows) for s in FULL.session.sensors] == [
        (s.name, s.columns, s.rows) for s in calibration.rig.sensors
    ]
    assert [len(c.states) for c in (FULL, SITE, SMALL)] == [31, 15, 9]
    # States of one label differ in their noise from test to session.
    assert SITE.scene is not None
    assert len({hat.scene.seed, FULL.scene.seed, SITE.scene.seed}) == 3


def test_light_is_neither_scarce_nor_too_much() -> None:
    for sim in [*simulations(SMALL, "board"), *simulations(SMALL, "bar")]:
        rendering = render(sim, SMALL.sequence)
        assert 0.5 < rendering.texture.max() / rendering.full_scale < 0.95
