"""First values of one sensor from its own views of a board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import degrees

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import CalibrationFailed
from sms_jobs.metrology.calibration.board_views import BoardView, Refusal
from sms_jobs.metrology.calibration.direct_linear_transform import direct_linear_transform
from sms_jobs.metrology.calibration.homography import HomographyFit, fit_homography
from sms_jobs.metrology.calibration.planar_intrinsics import (
    intrinsics_from_homographies,
    pose_from_homography,
    tilt,
)
from sms_jobs.metrology.calibration.sensor_refinement import RefinedSensor, SeenPoints, refine_sensor
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import LENS, Intrinsics

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_FEWEST_POINTS = 6
_FOCAL_LIMIT = 0.05
_CENTRE_LIMIT = 0.1
_LOOSE = 0.05  # of the image of the board: no lens bends that much, wrong places of points do
_GUESSES = (0.6, 1.2, 2.5)  # focal lengths in widths of the image: 80, 45 and 23 degrees across


@dataclass(frozen=True)
class SensorStart:
    """A sensor by itself: inner parameters, and the pose of each board that it saw.

    Attributes
    ----------
    intrinsics, lens_sigma
        Inner parameters and their standard deviations, in their order; 0 where held.
    poses
        Of each usable view, by the pose's name: x_sensor = R X_board + T.
    kept
        Of each usable view, (n,) the points that were used.
    rms_px
        Of each usable view, each coordinate.
    notes
        What was held because the views do not tell it.
    """

    intrinsics: Intrinsics
    lens_sigma: Floats
    poses: dict[str, Pose]
    kept: dict[str, Bools]
    rms_px: dict[str, float]
    notes: tuple[str, ...]


def usable_views(
    views: Sequence[BoardView],
) -> tuple[list[tuple[BoardView, HomographyFit]], list[Refusal]]:
    """Return the views that show a board at all, with their homographies, and why the others do not."""
    usable: list[tuple[BoardView, HomographyFit]] = []
    refused = []
    for view in views:
        n = len(view.point)
        if n < _FEWEST_POINTS:
            reason = f"fewer than {_FEWEST_POINTS} points of the board were found"
            refused.append(Refusal(view.sensor, view.pose, n, reason))
            continue
        try:
            fit = fit_homography(view.point[:, :2], view.pixel, view.sigma_px)
        except CalibrationFailed as error:
            refused.append(Refusal(view.sensor, view.pose, n, str(error)))
            continue
        spread = float(np.sqrt(np.mean(np.var(view.pixel, axis=0))))
        agree = int(fit.kept.sum()) if fit.rms_px < _LOOSE * spread else 0
        if agree < max(_FEWEST_POINTS, n // 2):
            reason = f"only {agree} of {n} points agree on where the board is"
            refused.append(Refusal(view.sensor, view.pose, n, reason))
        else:
            usable.append((view, fit))
    return usable, refused


def _candidates(
    fits: Sequence[HomographyFit], size: tuple[int, int], known_principal_point: bool
) -> list[Intrinsics]:
    """Return inner parameters to begin with; plain guesses where no closed form holds."""
    columns, rows = size
    centre = (0.5 * (columns - 1), 0.5 * (rows - 1))
    found = []
    ways = [True] if known_principal_point or len(fits) < 2 else [True, False]
    for known in ways:
        try:
            start = intrinsics_from_homographies(
                [f.matrix for f in fits], centre, known_principal_point=known
            )
        except CalibrationFailed:
            continue
        inside = abs(start.cx - centre[0]) < 1.5 * columns and abs(start.cy - centre[1]) < 1.5 * rows
        if inside and 0.1 * columns < start.fx < 50.0 * columns:
            found.append(start)
    if not found:
        found = [Intrinsics(g * columns, g * columns, *centre) for g in _GUESSES]
    return found


def _free(views: int, held: Mapping[str, float]) -> list[str]:
    """Return the names of what is found from so many views."""
    return [name for name, parameter in LENS.items() if parameter.poses <= views and name not in held]


def start_sensor(
    name: str,
    usable: Sequence[tuple[BoardView, HomographyFit]],
    size: tuple[int, int],
    held: Mapping[str, float],
) -> SensorStart:
    """Find a sensor from its own views of a board.

    Parameters
    ----------
    name
        Of the sensor, for messages.
    usable
        From `usable_views`.
    size
        Columns and rows of its image.
    held
        Parameters that are not estimated, and their values.

    Raises
    ------
    CalibrationFailed
        When it has no usable view, or when the views do not tell its focal length to 5 %: the board is
        nearly parallel to the image in all of them.
    """
    if not usable:
        raise CalibrationFailed(
            f"{name} saw no board that can be used: check that it is lit and in focus there"
        )
    seen = [SeenPoints(view.point, view.pixel, view.sigma_px) for view, _ in usable]
    trusted = [fit.kept for _, fit in usable]
    free, square = _free(len(usable), held), len(usable) < 3
    notes = []
    best = None
    for candidate in _candidates([fit for _, fit in usable], size, False):
        start = replace(candidate, **held)
        poses = [pose_from_homography(fit.matrix, start) for _, fit in usable]
        # Without the principal point at first: a poor focal length would drag it far away.
        near = refine_sensor(
            seen, start, poses, free=_free(1, held), square_pixels=True, trusted=trusted, refuse=False
        )
        full = refine_sensor(
            seen, near.intrinsics, near.poses, free=free, square_pixels=square, trusted=trusted
        )
        if best is None or full.scale < best.scale:
            best = full
    assert best is not None
    if "cx" in free and max(best.lens_sigma[2:4]) > _CENTRE_LIMIT * size[0]:
        notes.append(
            f"the principal point of {name} was held in the middle of the image: its views leave it open by "
            f"{max(best.lens_sigma[2:4]):.3g} px"
        )
        free = [n for n in free if n not in ("cx", "cy")]
        centre = (0.5 * (size[0] - 1), 0.5 * (size[1] - 1))
        nearest = _candidates([f for _, f in usable], size, True)[0]
        start = replace(Intrinsics(nearest.fx, nearest.fy, *centre), **held)
        poses = [pose_from_homography(fit.matrix, start) for _, fit in usable]
        best = refine_sensor(seen, start, poses, free=free, square_pixels=True, trusted=trusted)
    _check_focal(name, best, [view.pose for view, _ in usable])
    if len(usable) == 1:
        notes.append(f"{name} saw one pose: its principal point was held in the middle of the image")
    return _own(best, usable, tuple(notes))


def _check_focal(name: str, found: RefinedSensor, poses: Sequence[str]) -> None:
    """Refuse a focal length that the views do not tell."""
    relative = float(found.lens_sigma[0] / found.intrinsics.fx)
    if relative <= _FOCAL_LIMIT:
        return
    tilts = [degrees(tilt(pose)) for pose in found.poses]
    raise CalibrationFailed(
        f"the focal length of {name} is known to {100 * relative:.0f} % only, where "
        f"{100 * _FOCAL_LIMIT:.0f} % are needed: its {len(poses)} board pose(s) are tilted by "
        f"{max(tilts):.1f} degrees at most, show the board tilted by 20 to 45 degrees about both axes"
    )


def _own(
    found: RefinedSensor,
    usable: Sequence[tuple[BoardView, HomographyFit]],
    notes: tuple[str, ...],
) -> SensorStart:
    kept, rms, poses = {}, {}, {}
    for i, (view, _) in enumerate(usable):
        kept[view.pose] = found.kept[i]
        rms[view.pose] = float(np.sqrt(np.mean(found.residual[i][found.kept[i]] ** 2)))
        poses[view.pose] = found.poses[i]
    return SensorStart(found.intrinsics, found.lens_sigma, poses, kept, rms, notes)


def start_from_space(
    name: str,
    usable: Sequence[tuple[BoardView, HomographyFit]],
    board_poses: dict[str, Pose],
    held: Mapping[str, float],
) -> tuple[SensorStart, Pose]:
    """Find a sensor from boards whose places in the world are known, and its pose there.

    It needs no tilted board, only points that are not on one plane: what parallel poses at several distances
    do not tell a sensor by themselves, they do once another sensor has placed them.

    Raises `CalibrationFailed` for points on a plane, or fewer than 6.
    """
    placed = [(view, fit) for view, fit in usable if view.pose in board_poses]
    if not placed:
        raise CalibrationFailed(f"{name} saw no board whose place in the world is known")
    seen = [
        SeenPoints(
            v.point @ board_poses[v.pose].matrix().T + board_poses[v.pose].translation, v.pixel, v.sigma_px
        )
        for v, _ in placed
    ]
    points, pixels, sigma = (
        np.concatenate(parts) for parts in zip(*((s.point, s.pixel, s.sigma_px) for s in seen), strict=True)
    )
    trusted = np.concatenate([fit.kept for _, fit in placed])
    intrinsics, pose = direct_linear_transform(points[trusted], pixels[trusted], sigma[trusted])
    whole = refine_sensor(
        [SeenPoints(points, pixels, sigma)],
        replace(intrinsics, **held),
        [pose],
        free=_free(2, held),
        trusted=[trusted],
    )
    _check_focal(name, whole, [v.pose for v, _ in placed])
    ends = np.cumsum([len(s.point) for s in seen])[:-1]
    own = [
        Pose.from_arrays(
            whole.poses[0].matrix() @ board_poses[v.pose].matrix(),
            whole.poses[0].matrix() @ board_poses[v.pose].translation + whole.poses[0].translation,
        )
        for v, _ in placed
    ]
    split = RefinedSensor(
        whole.intrinsics,
        tuple(own),
        whole.lens_sigma,
        tuple(np.split(whole.kept[0], ends)),
        tuple(np.split(whole.residual[0], ends)),
        whole.scale,
        whole.cost,
    )
    note = (
        f"{name} was found by a DLT on boards that other sensors placed: its own views are not tilted enough"
    )
    return _own(split, placed, (note,)), whole.poses[0]
