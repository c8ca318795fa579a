"""Calibration sessions of cameras and a board that is not as told, made of exact geometry and noise.

What cameras would have seen of every point is computed by the virtual rig's own copy of the lens, and given
to the job kind `calibrate-boards` as `observe-board` would have: hundreds of sessions can be calibrated,
from first values to warnings, without rendering an image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sms_jobs.kinds.calibration import calibrate_boards
from sms_jobs.kinds.calibration.sessions import OBSERVED_BOARDS, session_plan
from sms_jobs.kinds.kind import DatasetOutput, Inputs
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics, Model
from sms_jobs.records.artefacts import Chessboard
from sms_jobs.records.calibration import CalibrationQuality
from sms_jobs.records.campaign import CalibrationSession, Campaign, LoadState, Specimen
from sms_jobs.records.observations import BoardObservation
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor, SensorFormat
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import Role
from sms_jobs.testing.in_memory import InMemory, unheard
from sms_jobs.virtual_rig.optics import image_point, packed_sensor

Bend = Callable[[Floats], Floats]
"""Height (n,) in mm of points (n, 2) that run from -1 to 1 across a board."""

NAME = "boards"
BOARD = Chessboard(13, 9, 12.0)
"""144 mm by 96 mm between its outermost corners."""

SIZE_PX = (1600, 1200)
_FEWEST_SEEN = 20
_ASIDE = 5.0  # focal lengths over the width of an image: boards are shown up to its corners
_WIDER = 0.3
"""Focal length of lenses that are not plain, of that of those that are: 70 to 150 degrees across."""
_WIDE_VOLUME = Box((12.0, -12.0, -60.0), (132.0, 108.0, 60.0))
"""What wide lenses are to measure: the box about all boards reaches far beyond their images."""
_BENT: dict[Model, dict[str, float]] = {
    "plain": {},
    "rational": {"k1": 0.9, "k2": 0.1, "k3": 0.003, "k4": 1.2, "k5": 0.28, "k6": 0.015},
    "fisheye": {"k1": 0.03, "k2": -0.01, "k3": 0.004, "k4": -0.001, "p1": 0.0, "p2": 0.0, "fisheye": 1.0},
}


def bow(height_mm: float) -> Bend:
    """Return a board whose ends along x stand out by a height."""
    return lambda at: height_mm * at[:, 0] ** 2


def flat(at: Floats) -> Floats:
    """Return a board as it should be."""
    return np.zeros(len(at))


@dataclass(frozen=True)
class BoardDesign:
    """What a session of boards is like.

    Attributes
    ----------
    cameras, poses
        How many.
    sigma_px
        Noise of a corner, as it is and as it is stated.
    bend
        The board's true shape.
    board
        As it is told; each of its points is printed off by its `point_sigma_mm`, in all poses alike.
    lens
        Of the cameras; all but plain ones see a wide angle, all over which boards are shown.
    """

    cameras: int = 2
    poses: int = 20
    sigma_px: float = 0.03
    bend: Bend = flat
    board: Chessboard = BOARD
    lens: Model = "plain"


@dataclass(frozen=True)
class BoardSession:
    """A session of boards before its calibration.

    Attributes
    ----------
    campaign
        Its plan.
    rig
        As it truly stands, in the frame of the first board's plane.
    observations
        What each camera saw in each pose.
    """

    campaign: Campaign
    rig: Rig
    observations: dict[Subject, BoardObservation]

    def changed(self, change: Mapping[Subject, BoardObservation]) -> BoardSession:
        """Return the session with other observations of some views."""
        return replace(self, observations={**self.observations, **change})


def board_session(design: BoardDesign, seed: int) -> BoardSession:
    """Return a session whose rig, poses and noise are drawn from a seed."""
    random = np.random.default_rng(seed)
    rig, distance = _rig(design, random)
    aside = 1.0 if design.lens == "plain" else _ASIDE * SIZE_PX[0] / rig.sensors[0].intrinsics.fx
    labels = [f"B{k + 1:02d}" for k in range(design.poses)]
    place, told, true = _points(design, random)
    observations = {}
    for number, label in enumerate(labels):
        pose = _pose(number, distance, random, aside)
        for sensor in rig.sensors:
            world = true @ pose.matrix().T + pose.translation
            packed = packed_sensor(sensor)
            pixel = np.array([image_point(packed, *point) for point in world])
            seen = np.all((pixel > 2.0) & (pixel < np.array(SIZE_PX) - 3.0), axis=1)
            if seen.sum() < _FEWEST_SEEN:
                seen[:] = False
            noisy = pixel[seen] + design.sigma_px * random.standard_normal((int(seen.sum()), 2))
            subject = Subject(NAME, label, sensor.name)
            observations[subject] = _observation(sensor.name, place[seen], told[seen], noisy, design.sigma_px)
    session = CalibrationSession(
        {"board": design.board},
        tuple(SensorFormat(s.name, s.columns, s.rows) for s in rig.sensors),
        volume=None if design.lens == "plain" else _WIDE_VOLUME,
    )
    states = tuple(LoadState(label, artefact="board") for label in labels)
    views = tuple(s.name for s in rig.sensors)
    campaign = Campaign(NAME, Specimen("board"), "rig", states, views, session=session)
    return BoardSession(campaign, rig, observations)


def _points(design: BoardDesign, random: np.random.Generator) -> tuple[NDArray[np.int32], Floats, Floats]:
    """Return places, points as told and points as they are, the plane that fits them best at z = 0."""
    board = design.board
    rows, columns = np.mgrid[: board.rows, : board.columns]
    place = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(np.int32)
    told = np.pad(board.pitch_mm * place.astype(float), ((0, 0), (0, 1)))
    unit = 2.0 * place / [board.columns - 1, board.rows - 1] - 1.0
    height = design.bend(unit)
    plane = np.column_stack([np.ones(len(unit)), unit])
    height = height - plane @ np.linalg.lstsq(plane, height, rcond=None)[0]
    printed = told + board.point_sigma_mm * random.standard_normal(told.shape)
    return place, told, printed + np.outer(height, [0.0, 0.0, 1.0])


def _rig(design: BoardDesign, random: np.random.Generator) -> tuple[Rig, float]:
    """Return cameras side by side that look at where boards are shown, and their distance from there."""
    columns, rows = SIZE_PX
    focal = random.uniform(1.1, 2.2) * columns * (1.0 if design.lens == "plain" else _WIDER)
    distance = focal * 144.0 / (random.uniform(0.45, 0.6) * columns)
    angle = np.radians(random.uniform(10.0, 25.0))
    sensors = []
    for k in range(design.cameras):
        turn = (k - 0.5 * (design.cameras - 1)) * angle
        centre = distance * np.array([np.sin(turn), 0.03 * random.standard_normal(), -np.cos(turn)])
        target = np.array([72.0, 48.0, 0.0])
        pose = Pose.looking_at(centre + target, target, np.array([0.0, -1.0, 0.0]))
        own = focal * (1.0 + 0.01 * random.standard_normal())
        inner = Intrinsics(
            own,
            own * (1.0 + 1e-3 * random.standard_normal()),
            0.5 * columns + 15.0 * random.standard_normal(),
            0.5 * rows + 15.0 * random.standard_normal(),
            *(random.uniform(-0.15, 0.05), random.uniform(-0.1, 0.2)),
            *(3e-4 * random.standard_normal(2)),
        )
        bent = replace(inner, **_BENT[design.lens])
        sensors.append(Sensor(f"C{k + 1}", Role.CAMERA, columns, rows, bent, pose))
    return Rig("rig", tuple(sensors)), distance


def _pose(number: int, distance: float, random: np.random.Generator, aside: float) -> Pose:
    """Return where a board is held: the first facing the rig, the others tilted, turned and moved aside."""
    middle = np.array([72.0, 48.0, 0.0])
    if number == 0:
        return Pose.from_arrays(np.eye(3), np.zeros(3))
    way = 2.0 * np.pi * (0.618 * number)
    tilt = np.radians(random.uniform(20.0, 42.0))
    turn = Rotation.from_rotvec([tilt * np.cos(way), tilt * np.sin(way), 0.0])
    turn = turn * Rotation.from_rotvec([0.0, 0.0, np.radians(random.uniform(-100.0, 100.0))])
    shift = random.uniform(-1.0, 1.0, 3) * [
        0.2 * aside * distance / 2,
        0.15 * aside * distance / 2,
        0.12 * distance,
    ]
    matrix = turn.as_matrix()
    return Pose.from_arrays(matrix, middle + shift - matrix @ middle)


def _observation(
    camera: str, place: NDArray[np.int32], point: Floats, pixel: Floats, sigma_px: float
) -> BoardObservation:
    count = len(place)
    nowhere, unknown = np.full((count, 2), np.nan), np.full(count, np.nan)
    sigma = np.full(count, sigma_px)
    return BoardObservation(
        camera, "", "board", float("nan"), {}, place, point, pixel, sigma, nowhere, unknown
    )


@dataclass(frozen=True)
class Calibrated:
    """What the job `calibrate-boards` gives of a session."""

    calibration: Calibration
    quality: CalibrationQuality
    covariance: Floats


def calibrated(made: BoardSession, **options: Any) -> Calibrated:
    """Run the job in memory; raises `CalibrationFailed` as it does."""
    kind, campaign = calibrate_boards.KIND, made.campaign
    subject = Subject(campaign.name)
    parameters = kind.parameters(**{"folds": 2, "figure_width_px": 400, **options})
    datasets = {
        OBSERVED_BOARDS.role(own): InMemory(own, {"observation": seen})
        for own, seen in made.observations.items()
    }
    inputs = Inputs(subject, session_plan(campaign, subject), datasets, 1)
    for output in kind.run(inputs, parameters, unheard):
        if isinstance(output, DatasetOutput):
            records = output.records
            return Calibrated(records["calibration"], records["quality"], records["uncertainty"].covariance)
    raise AssertionError("calibrate-boards gave no calibration")


def parameter_z(made: BoardSession, found: Calibrated) -> dict[str, float]:
    """Return error over stated deviation of every parameter that was found, by name.

    Inner parameters of every camera, and how each camera stands to the first: rotations in its frame, and
    translations, which have the board's scale.
    """
    z = {}
    true, got = made.rig.sensors, found.calibration.rig.sensors
    size = len(found.covariance) // len(got)
    sigma = np.sqrt(np.diag(found.covariance)).reshape(-1, size)
    for k, (a, b) in enumerate(zip(true, got, strict=True)):
        off = b.intrinsics.vector() - a.intrinsics.vector()
        names = [*Intrinsics.__dataclass_fields__]
        for name, error, own in zip(names, off, sigma[k, 6:], strict=True):
            if own > 0.0:
                z[f"{a.name}.{name}"] = float(error / own)
    for k in range(1, len(true)):
        z.update(_relative_z(made, found, k, size))
    return z


def _relative_z(made: BoardSession, found: Calibrated, k: int, size: int) -> dict[str, float]:
    """Return the z of camera k's motion from the first, by numerical derivatives of the motion."""
    got = found.calibration.rig.sensors

    def motion(change: Floats) -> Floats:
        poses = []
        for number, sensor in enumerate((got[0], got[k])):
            own = change[6 * number : 6 * number + 6]
            turn = Rotation.from_rotvec(own[:3]).as_matrix() @ sensor.pose.matrix()
            poses.append((turn, np.array(sensor.pose.translation) + own[3:]))
        (r1, t1), (r2, t2) = poses
        turn = r2 @ r1.T
        true = _motion(made.rig.sensors[0].pose, made.rig.sensors[k].pose)
        away = Rotation.from_matrix(turn @ true[0].T).as_rotvec()
        return np.concatenate([away, t2 - turn @ t1 - true[1]])

    at = np.concatenate([np.arange(6), size * k + np.arange(6)])
    covariance = found.covariance[np.ix_(at, at)]
    steps = np.array([1e-6] * 3 + [1e-4] * 3 + [1e-6] * 3 + [1e-4] * 3)
    slopes = np.stack([(motion(d) - motion(-d)) / (2.0 * d.max()) for d in np.diag(steps)], axis=1)
    own = np.sqrt(np.diag(slopes @ covariance @ slopes.T))
    names = [f"C{k + 1}-C1.{p}" for p in ("rx", "ry", "rz", "tx", "ty", "tz")]
    return dict(zip(names, (motion(np.zeros(12)) / own).tolist(), strict=True))


def _motion(first: Pose, other: Pose) -> tuple[Floats, Floats]:
    turn = other.matrix() @ first.matrix().T
    return turn, np.array(other.translation) - turn @ np.array(first.translation)
