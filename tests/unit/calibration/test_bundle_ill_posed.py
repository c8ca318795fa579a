"""Observations that leave a calibration open, or contradict what is certified: named and refused."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.bench.sessions.bar_session import TABLE_3, BarSession, SessionDesign, bar_session
from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.calibration.bundle.adjustment import adjust
from sms_jobs.metrology.calibration.bundle.checks import _in_sight
from sms_jobs.metrology.calibration.bundle.problem import BarPoints, BundleProblem
from sms_jobs.metrology.calibration.bundle.weak_directions import described, weakest_direction
from sms_jobs.metrology.calibration.pair_points import box_grid
from sms_jobs.metrology.geometry.camera import PER_SENSOR, project
from sms_jobs.metrology.geometry.lens import KEPT

NAMES = ("C1", "C2", "P1", "P2")
SMALL = SessionDesign(
    points=30, camera_pixels=512, angles=TABLE_3[::3], board_tilts=((0.0, 0.0, 0.0), (0.3, 0.2, 0.0))
)


@cache
def session(design: SessionDesign = SMALL) -> BarSession:
    return bar_session(design, 11)


def chosen(seen: BarPoints, flags: NDArray[np.bool_]) -> BarPoints:
    return replace(
        seen,
        sphere=seen.sphere[flags],
        camera_px=seen.camera_px[flags],
        projector_px=seen.projector_px[flags],
        sigma_px=seen.sigma_px[flags],
    )


def only(problem: BundleProblem, bars: tuple[int, ...], boards: tuple[int, ...]) -> BundleProblem:
    return replace(
        problem,
        bar_points=tuple(p for p in problem.bar_points if p.pose in bars),
        board_points=tuple(p for p in problem.board_points if p.pose in boards),
        world_board=0 if boards else None,
    )


def test_a_single_board_pose_is_refused() -> None:
    # A plane that faces a sensor cannot tell focal length from distance.
    with pytest.raises(CalibrationFailed, match=r"focal length|distance|principal point"):
        adjust(only(session().problem, (), (0,)))


def test_a_single_bar_pose_is_refused() -> None:
    with pytest.raises(CalibrationFailed, match=r"trade against each other.*add"):
        adjust(only(session().problem, (4,), ()))


def test_bar_poses_in_one_plane_are_doubted_and_the_plane_is_named() -> None:
    angles = tuple((pan, 0.0) for pan in (-45.0, -20.0, 0.0, 20.0, 45.0))
    flat = SessionDesign(points=30, camera_pixels=512, angles=angles, board_tilts=())
    warnings = adjust(session(flat).problem).warnings
    assert any(re.search(r"of [CP][12].* trade against each other.*of one plane", w) for w in warnings)


@pytest.mark.parametrize(("tilt", "doubted"), [(0.1, True), (0.3, False)])
def test_a_camera_alone_whose_boards_are_hardly_tilted_is_doubted(tilt: float, doubted: bool) -> None:
    tilts = ((0.0, 0.0, 0.0), (tilt, 0.0, 0.0), (-tilt, tilt, 0.0), (0.0, -tilt, 0.5))
    rig = session(SessionDesign(camera_pixels=512, angles=(), board_tilts=tilts)).problem
    boards = tuple(p for p in rig.board_points if p.sensor == 0)
    found = adjust(replace(rig, sensors=rig.sensors[:1], board_points=boards))
    warned = [bool(re.match(r"f[xy] of C1 is uncertain by 0.*wanted.*; add ", w)) for w in found.warnings]
    assert warned == [True] * doubted


def test_focal_length_and_distance_are_named_when_they_trade() -> None:
    normal = np.eye(4 * PER_SENSOR)
    f, d = 3 * PER_SENSOR + 6, 3 * PER_SENSOR + 5  # of P2
    normal[f, d] = normal[d, f] = -1.0 + 1e-9
    direction = weakest_direction(normal, np.arange(len(normal)))
    text = described(direction, np.arange(len(normal)), NAMES)
    assert "of P2 and its" in text
    assert "focal length" in text
    assert "distance" in text
    assert "trade against each other; add poses at other depths" in text


def test_a_sensor_that_sees_too_little_is_named() -> None:
    problem = session().problem
    c2 = [p for p in problem.bar_points if p.camera == 1][:1]
    # Three points on one sphere and two on the other; that pose has other pairs' points on both.
    few = [chosen(p, np.isin(np.arange(len(p.sphere)), [0, 1, 2, 30, 31])) for p in c2]
    rest = [p for p in problem.bar_points if p.camera != 1]
    boards = tuple(p for p in problem.board_points if p.sensor != 1)
    free = PER_SENSOR - len(KEPT)
    with pytest.raises(
        CalibrationFailed,
        match=rf"C2 has [0-9]+ residuals for {free} free parameters, at least {2 * free}",
    ):
        adjust(replace(problem, bar_points=tuple(rest + few), board_points=boards))


def test_sensors_without_a_common_pose_are_named() -> None:
    problem = session().problem
    bars = tuple(p for p in problem.bar_points if (p.camera, p.projector) in ((0, 2), (1, 3)))
    apart = tuple(p for p in bars if (p.pose < 4) == (p.camera == 0))
    with pytest.raises(CalibrationFailed, match="C1, P1 and C2, P2 share no pose"):
        adjust(replace(problem, bar_points=apart, board_points=(), world_board=None))


def test_a_sensor_that_saw_nothing_is_named() -> None:
    problem = session().problem
    bars = tuple(p for p in problem.bar_points if p.projector != 3)
    boards = tuple(p for p in problem.board_points if p.sensor != 3)
    with pytest.raises(CalibrationFailed, match="nothing was observed with P2"):
        adjust(replace(problem, bar_points=bars, board_points=boards))


def test_no_scale_is_refused() -> None:
    problem = only(session().problem, tuple(range(9)), ())

    alone = tuple(chosen(p, p.sphere == 1) for p in problem.bar_points)
    with pytest.raises(CalibrationFailed, match="nothing observed has a known length"):
        adjust(replace(problem, bar_points=alone))


def test_swapped_spheres_are_found_and_the_pose_is_named() -> None:
    problem = session().problem
    wrong = problem.bar_points[13]
    points = [replace(p, sphere=3 - p.sphere) if p is wrong else p for p in problem.bar_points]
    pair = NAMES[wrong.camera] + NAMES[wrong.projector]
    pose = problem.bar_poses[wrong.pose].name
    with pytest.raises(CalibrationFailed, match=f"the spheres of pose {pose} are swapped in pair {pair}"):
        adjust(replace(problem, bar_points=tuple(points)))


@pytest.mark.parametrize("artefact", ["bar", "pitch"])
def test_a_bar_and_a_board_that_disagree_are_reported(artefact: str) -> None:
    problem = session(replace(SMALL, pitch_relative_sigma=2e-5)).problem
    if artefact == "bar":
        problem = replace(problem, bars=(replace(problem.bars[0], length_mm=500.1),))
    else:
        boards = tuple(replace(p, point=p.point * (1.0 - 2e-4)) for p in problem.board_points)
        problem = replace(problem, board_points=boards)
    # 2e-4 is 10 sigma of the pitch; the measurement itself and the bar's 4e-6 take some of it.
    told = [w for w in adjust(problem).warnings if "disagree by" in w]
    assert len(told) == 1
    assert "of bar" in told[0]
    assert "the pitch of board disagree by" in told[0]


def test_a_wrong_radius_is_reported() -> None:
    problem = session().problem
    warnings = adjust(replace(problem, bars=(replace(problem.bars[0], radius_mm=30.05),))).warnings
    assert any("the radius of sphere 1 of bar is stated as 30.05 mm" in w for w in warnings)


def test_a_bad_pose_is_named() -> None:
    problem = session().problem
    rng = np.random.default_rng(3)
    points = tuple(
        replace(p, projector_px=p.projector_px + rng.normal(0.0, 0.3, p.projector_px.shape))
        if p.pose == 2
        else p
        for p in problem.bar_points
    )
    warnings = adjust(replace(problem, bar_points=points)).warnings
    assert any("pose A03" in w for w in warnings)
    assert not any("A04" in w for w in warnings)


def test_a_world_that_one_sensor_sees_alone_is_reported() -> None:
    problem = session().problem
    boards = tuple(p for p in problem.board_points if p.pose != 0 or p.sensor == 0)
    warnings = adjust(replace(problem, board_points=boards)).warnings
    assert any("board frame of pose B01, which is the world, is seen by C1 alone" in w for w in warnings)


def test_a_sphere_that_nobody_saw_is_no_obstacle() -> None:
    problem = session().problem
    own = [chosen(p, p.sphere == 1) if p.pose == 5 else p for p in problem.bar_points]
    poses = list(problem.bar_poses)
    poses[5] = replace(poses[5], centres=np.stack([poses[5].centres[0], np.full(3, np.nan)]))
    found = adjust(replace(problem, bar_points=tuple(own), bar_poses=tuple(poses)))
    assert np.isnan(found.centres[5, 1]).all()
    assert np.isfinite(np.delete(found.centres.reshape(-1, 3), 11, axis=0)).all()


def test_numbers_that_name_nothing_are_refused() -> None:
    problem = session().problem
    with pytest.raises(InvalidInput, match="sensor 7 is named, but the problem has 4"):
        replace(problem, board_points=(replace(problem.board_points[0], sensor=7),))
    with pytest.raises(InvalidInput, match="has no parameter k9"):
        replace(problem, sensors=(replace(problem.sensors[0], fixed=("k9",)), *problem.sensors[1:]))


def test_what_no_image_shows_of_a_volume_is_not_judged() -> None:
    problem = session().problem
    low, high = np.full(3, -200.0), np.full(3, 200.0)
    sensors = problem.sensors[0], problem.sensors[2]
    pair = [(s.intrinsics, s.pose) for s in sensors]
    far = [np.full(3, -1500.0), np.full(3, 1500.0)]
    whole = _in_sight(pair, [s.size_px for s in sensors], low, high)
    np.testing.assert_allclose(whole, box_grid(low, high, 3))
    part = _in_sight(pair, [s.size_px for s in sensors], *far)
    assert np.isfinite(part).all()
    for sensor in sensors:
        pixel = project(sensor.intrinsics, sensor.pose, part)
        assert ((pixel > -0.51) & (pixel < np.array(sensor.size_px) - 0.49)).all()
    nowhere = _in_sight(pair, [s.size_px for s in sensors], np.full(3, 1e5), np.full(3, 2e5))
    assert np.isnan(nowhere).all()
