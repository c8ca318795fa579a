"""First values for a calibration: every sensor, camera or projector alike, and every board in one world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.board_views import BoardView, Refusal
from sms_jobs.metrology.calibration.shared_poses import drop_unshared
from sms_jobs.metrology.calibration.starting.sensor_refinement import SeenPoints, refine_sensor
from sms_jobs.metrology.calibration.starting.sensor_start import (
    SensorStart,
    start_from_space,
    start_sensor,
    usable_views,
)
from sms_jobs.metrology.calibration.starting.view_fit import ViewFit
from sms_jobs.metrology.geometry.camera import Pose, project, projection_jacobian
from sms_jobs.metrology.geometry.lens import Intrinsics, Model
from sms_jobs.metrology.geometry.transforms import compose, inverse, rotation_matrix, transform

_SWEEPS = 6
_NEWTON_STEPS = 3
_REFUSED_VIEW = 5.0  # times the rms of the sensor's views
_FAR_PX = 2.0  # and at least so much more, each coordinate

_IDENTITY = Pose(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class InitialSensor:
    """A sensor in the world.

    Attributes
    ----------
    intrinsics, pose
        Inner parameters; the pose maps the world into the sensor.
    size_px
        Columns and rows of its image.
    lens_sigma
        (parameters,) standard deviations of those of the lens from its own views; 0 where held.
    notes
        What was held because the views do not tell it.
    """

    intrinsics: Intrinsics
    pose: Pose
    size_px: tuple[int, int]
    lens_sigma: Floats
    notes: tuple[str, ...]


@dataclass(frozen=True)
class InitialView:
    """How well one view fits.

    Attributes
    ----------
    view
        With its refused points left out.
    own_rms_px
        With the sensor by itself, each coordinate.
    rms_px
        With all sensors and boards in one world.
    """

    view: BoardView
    own_rms_px: float
    rms_px: float


@dataclass(frozen=True)
class InitialCalibration:
    """First values of a calibration.

    Attributes
    ----------
    sensors
        By name.
    board_poses
        By name, X_world = R X_board + T.
    world_pose
        The pose whose board is the world's frame.
    views
        Those that are used.
    refused
        What is not.
    """

    sensors: dict[str, InitialSensor]
    board_poses: dict[str, Pose]
    world_pose: str
    views: tuple[InitialView, ...]
    refused: tuple[Refusal, ...]


def initialise(
    views: Sequence[BoardView],
    sizes: Mapping[str, tuple[int, int]],
    *,
    board_in_world: Pose | None = None,
    world_pose: str | None = None,
    held: Mapping[str, float] | None = None,
    models: Mapping[str, Model] | None = None,
) -> InitialCalibration:
    """Find first values of every sensor from what they saw of a board, in one pose or many.

    Parameters
    ----------
    views
        One for each sensor and pose; not every sensor need see every pose.
    sizes
        Columns and rows of the image of each sensor, by name; these are the sensors to be found.
    board_in_world
        Brings the frame of the first board into the world; by default the two are one.
    world_pose
        Name of the first board's pose; by default that of the first view.
    held
        Parameters of every lens that are not estimated, and their values.
    models
        Of the lenses that are not plain, by the name of the sensor.

    Raises
    ------
    InvalidInput
        For two views of one sensor and pose, a sensor without a size, or no views.
    CalibrationFailed
        When a sensor cannot be found (its views are not tilted, too few, or wrong), or shares no pose with
        the others, directly or through others. The message names it. When two sensors agree in no half
        of the poses that they share.

    Notes
    -----
    Each sensor by itself as Zhang 2000; one whose views are all parallel to its image by a DLT, once others
    have placed the boards. Poses are chained from the first board outwards, then sensors and boards are
    moved in turn until their images fit, which is good enough for a bundle adjustment to start from.
    """
    world = _checked(views, sizes, world_pose)
    lenses = models or {}
    usable, refused = usable_views(views, [name for name, model in lenses.items() if model != "plain"])
    starts: dict[str, SensorStart] = {}
    failed: dict[str, CalibrationFailed] = {}
    for name, size in sizes.items():
        own = [u for u in usable if u[0].sensor == name]
        try:
            starts[name] = start_sensor(name, own, size, held or {}, lenses.get(name, "plain"))
        except CalibrationFailed as error:
            failed[name] = error
    if not starts:
        raise next(iter(failed.values()))
    refused += _drop_wrong_views(starts)
    refused += drop_unshared(starts, [view for view, _ in usable], world)
    poses, boards = _chain(starts, world, board_in_world or _IDENTITY)
    for name, first in failed.items():
        if lenses.get(name, "plain") != "plain":
            raise first
        own = [u for u in usable if u[0].sensor == name]
        try:
            starts[name], poses[name] = start_from_space(name, own, boards, held or {})
        except CalibrationFailed as second:
            raise CalibrationFailed(
                f"{first}; nor do boards placed by other sensors help: {second}"
            ) from second
    _check_connected(starts, poses, world)
    used = [v.part(starts[v.sensor].kept[v.pose]) for v, _ in usable if v.pose in starts[v.sensor].poses]
    _settle(starts, used, poses, boards, world)
    return _result(starts, sizes, used, usable, poses, boards, world, refused)


def _checked(views: Sequence[BoardView], sizes: Mapping[str, tuple[int, int]], world_pose: str | None) -> str:
    """Return the name of the world's pose."""
    if not views:
        raise InvalidInput(
            "there are no views of a board: a calibration needs at least one pose, seen by every sensor"
        )
    seen = set()
    for view in views:
        if view.sensor not in sizes:
            raise InvalidInput(f"the size of the image of {view.sensor} is not given")
        if (view.sensor, view.pose) in seen:
            raise InvalidInput(f"there are two views of {view.sensor} in pose {view.pose}: give one")
        seen.add((view.sensor, view.pose))
    world = world_pose if world_pose is not None else views[0].pose
    if world not in {v.pose for v in views}:
        raise InvalidInput(f"no sensor saw the board in pose {world}, which is to be the world's frame")
    return world


def _drop_wrong_views(starts: dict[str, SensorStart]) -> list[Refusal]:
    """Take views out that fit their sensor far worse than its others; return them."""
    refused = []
    for name, start in starts.items():
        usual = float(np.median(list(start.rms_px.values())))
        for pose, rms in list(start.rms_px.items()):
            kept = start.kept[pose]
            few = kept.sum() < max(6, len(kept) // 2)
            if few or (rms > _REFUSED_VIEW * usual and rms > usual + _FAR_PX):
                reason = (
                    f"only {int(kept.sum())} of {len(kept)} points fit what the sensor's other views make "
                    f"of it, {rms:.3g} px where they have {usual:.3g} px: is it an image of another camera?"
                )
                refused.append(Refusal(name, pose, len(kept), reason, wrong=True))
                for table in (start.poses, start.kept, start.rms_px):
                    del table[pose]
    return refused


def _chain(
    starts: Mapping[str, SensorStart], world: str, first: Pose
) -> tuple[dict[str, Pose], dict[str, Pose]]:
    """Place sensors and boards from the first board outwards, as far as shared poses reach."""
    sensors: dict[str, Pose] = {}
    boards = {world: first}
    grown = True
    while grown:
        grown = False
        for name, start in starts.items():
            shared = [p for p in start.poses if p in boards]
            if name not in sensors and shared:
                best = min(shared, key=lambda p: start.rms_px[p])
                sensors[name] = compose(start.poses[best], inverse(boards[best]))
                grown = True
        for name, pose in sensors.items():
            for board, seen in starts[name].poses.items():
                if board not in boards:
                    boards[board] = compose(inverse(pose), seen)
                    grown = True
    return sensors, boards


def _check_connected(starts: Mapping[str, SensorStart], poses: Mapping[str, Pose], world: str) -> None:
    apart = [name for name in starts if name not in poses]
    if not apart:
        return
    placed = ", ".join(poses) or "no sensor"
    raise CalibrationFailed(
        f"{', '.join(apart)} cannot be placed in the world, the board in pose {world}: of its usable "
        f"poses ({', '.join(starts[apart[0]].poses) or 'none'}) none is shared with "
        f"{placed}, directly or through others; record a pose that both see"
    )


def _settle(
    starts: Mapping[str, SensorStart],
    views: Sequence[BoardView],
    poses: dict[str, Pose],
    boards: dict[str, Pose],
    world: str,
) -> None:
    """Move sensors and boards in turn to where all images fit best; the world's board stays."""
    for _ in range(_SWEEPS):
        for name in boards:
            if name != world:
                own = [v for v in views if v.pose == name]
                boards[name] = _board_pose(boards[name], own, starts, poses)
        for name in poses:
            own = [v for v in views if v.sensor == name]
            points = np.concatenate([transform(boards[v.pose], v.in_space) for v in own])
            pixels, sigma = (np.concatenate([getattr(v, k) for v in own]) for k in ("pixel", "sigma_px"))
            seen = [SeenPoints(points, pixels, sigma)]
            moved = refine_sensor(seen, starts[name].intrinsics, [poses[name]], free=(), refuse=False)
            poses[name] = moved.poses[0]


def _board_pose(
    pose: Pose, views: Sequence[BoardView], starts: Mapping[str, SensorStart], sensors: Mapping[str, Pose]
) -> Pose:
    """Fit the pose of one board to all its images by Gauss-Newton."""
    for _ in range(_NEWTON_STEPS):
        a, g = np.zeros((6, 6)), np.zeros(6)
        for view in views:
            sensor = (starts[view.sensor].intrinsics, sensors[view.sensor])
            turned = view.in_space @ pose.matrix().T
            world = turned + pose.translation
            by_point = projection_jacobian(*sensor, world)
            x, y, z = turned.T
            zero = np.zeros_like(x)
            by_turn = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 0, 1)  # -[RX]x
            rows = np.concatenate([by_point @ by_turn, by_point], axis=2) / view.sigma_px[:, None, None]
            off = (view.pixel - project(*sensor, world)) / view.sigma_px[:, None]
            a += np.einsum("nij,nik->jk", rows, rows)
            g += np.einsum("nij,ni->j", rows, off)
        step: Floats = np.asarray(np.linalg.solve(a, g), dtype=np.float64)
        pose = Pose.from_arrays(rotation_matrix(step[:3]) @ pose.matrix(), step[3:] + pose.translation)
    return pose


def _result(
    starts: Mapping[str, SensorStart],
    sizes: Mapping[str, tuple[int, int]],
    used: Sequence[BoardView],
    usable: Sequence[tuple[BoardView, ViewFit]],
    poses: Mapping[str, Pose],
    boards: Mapping[str, Pose],
    world: str,
    refused: list[Refusal],
) -> InitialCalibration:
    found = []
    for view in used:
        own = starts[view.sensor]
        off = view.pixel - project(
            own.intrinsics, poses[view.sensor], transform(boards[view.pose], view.in_space)
        )
        found.append(InitialView(view, own.rms_px[view.pose], float(np.sqrt(np.mean(off**2)))))
    for view, _ in usable:
        kept = starts[view.sensor].kept.get(view.pose)
        if kept is not None and not kept.all():
            reason = "the point is far from where the others put it"
            refused.append(Refusal(view.sensor, view.pose, int((~kept).sum()), reason))
    sensors = {
        name: InitialSensor(start.intrinsics, poses[name], sizes[name], start.lens_sigma, start.notes)
        for name, start in starts.items()
    }
    return InitialCalibration(sensors, dict(boards), world, tuple(found), tuple(refused))
