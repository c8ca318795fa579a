"""First values of one sensor from its own views of a board."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import degrees, isinf

import numpy as np

from sms_jobs.errors import CalibrationFailed
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.board_views import BoardView, Refusal
from sms_jobs.metrology.calibration.starting.direct_linear_transform import direct_linear_transform
from sms_jobs.metrology.calibration.starting.homography import fit_homography
from sms_jobs.metrology.calibration.starting.planar_intrinsics import (
    intrinsics_from_homographies,
    pose_from_homography,
    tilt,
)
from sms_jobs.metrology.calibration.starting.sensor_refinement import RefinedSensor, SeenPoints, refine_sensor
from sms_jobs.metrology.calibration.starting.view_fit import ViewFit, fit_view
from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.lens import LENS, Intrinsics, Model, distort, fixed_by_default, undistort
from sms_jobs.metrology.geometry.transforms import rotation_matrix

_FEWEST_POINTS = 6
_FOCAL_LIMIT = 0.05
_CENTRE_LIMIT = 0.1
_LOOSE = 0.05  # of the image of the board: no plain lens bends that much, wrong places of points do
_LOOSE_BENT = 0.2  # and no other one that
_WIDE_GUESSES = (0.22, 0.32, 0.45, 0.65, 0.95, 1.4, 2.0)  # of a fisheye: 260 to 29 degrees across
_TRIED = 2  # of those guesses, the ones that fit best
_RADII = 200  # at which a fisheye is made a rational lens
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
    kept: dict[str, Mask]
    rms_px: dict[str, float]
    notes: tuple[str, ...]


def usable_views(
    views: Sequence[BoardView], bent: Collection[str] = ()
) -> tuple[list[tuple[BoardView, ViewFit]], list[Refusal]]:
    """Return the views that show a board at all, with a pin-hole camera each, and why the others do not.

    `bent` names sensors whose lens bends straight lines by far more than a plain one.
    """
    usable: list[tuple[BoardView, ViewFit]] = []
    refused = []
    for view in views:
        n = len(view.point)
        if n < _FEWEST_POINTS:
            reason = f"fewer than {_FEWEST_POINTS} points of the board were found"
            refused.append(Refusal(view.sensor, view.pose, n, reason))
            continue
        try:
            fit = fit_view(view)
        except CalibrationFailed as error:
            refused.append(Refusal(view.sensor, view.pose, n, str(error)))
            continue
        spread = float(np.sqrt(np.mean(np.var(view.pixel, axis=0))))
        loose = _LOOSE_BENT if view.sensor in bent else _LOOSE
        agree = int(fit.kept.sum()) if fit.rms_px < loose * spread else 0
        if agree < max(_FEWEST_POINTS, n // 2):
            reason = f"only {agree} of {n} points agree on where the board is"
            refused.append(Refusal(view.sensor, view.pose, n, reason))
        else:
            usable.append((view, fit))
    return usable, refused


def _candidates(
    fits: Sequence[ViewFit], size: tuple[int, int], known_principal_point: bool
) -> list[Intrinsics]:
    """Return inner parameters to begin with; plain guesses where no closed form holds."""
    columns, rows = size
    centre = (0.5 * (columns - 1), 0.5 * (rows - 1))
    found = []
    several = sum(len(f.planes()) for f in fits) > 1
    ways = [True, False] if several and not known_principal_point else [True]
    for known in ways:
        try:
            start = intrinsics_from_homographies(
                [plane for f in fits for plane in f.planes()], centre, known_principal_point=known
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


def seen_pose(intrinsics: Intrinsics, point: Floats, pixel: Floats) -> Pose:
    """Return the pose of a board (x_sensor = R X_board + T) whose points (n, 3) a known lens sees at pixels.

    Points of a flat board have z = 0. Raises `CalibrationFailed` where fewer than six of the pixels have a
    ray.
    """
    i = intrinsics
    flat = undistort(i, (pixel - [i.cx, i.cy]) / [i.fx, i.fy])
    there = np.isfinite(flat).all(axis=1)
    if there.sum() < _FEWEST_POINTS:
        raise CalibrationFailed(
            f"only {int(there.sum())} of {len(pixel)} points are where the lens sees, and at least "
            f"{_FEWEST_POINTS} are needed"
        )
    rays = np.concatenate([flat[there], np.ones((int(there.sum()), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # Seen along the middle of the board, so that no point is far out on a plane before the sensor.
    middle = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
    axis, angle = np.array([-middle[1], middle[0], 0.0]), float(np.arccos(min(1.0, middle[2])))
    turn = rotation_matrix(axis * angle / max(float(np.linalg.norm(axis)), 1e-12))
    turned = rays @ turn
    if point[:, 2].any():
        pose = _pose_in_space(point[there], turned[:, :2] / turned[:, 2:])
        return Pose.from_arrays(turn @ pose.matrix(), turn @ np.array(pose.translation))
    with np.errstate(all="ignore"):  # a lens that is far off makes no plane of a board
        homography = fit_homography(point[there, :2], turned[:, :2] / turned[:, 2:]).matrix
    if not np.isfinite(homography).all():
        raise CalibrationFailed("the points lie on no plane that this lens could see")
    pose = pose_from_homography(homography, Intrinsics(1.0, 1.0, 0.0, 0.0))
    return Pose.from_arrays(turn @ pose.matrix(), turn @ np.array(pose.translation))


def _pose_in_space(point: Floats, image: Floats) -> Pose:
    """Return the pose in which a camera of focal length 1 sees points (n, 3), not on a plane, at (n, 2).

    Terzakis and Lourakis 2020, as OpenCV has it: it holds however little the points are off a plane.
    """
    import cv2

    found, turn, shift = cv2.solvePnP(point, image, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    if not found or not np.isfinite([turn, shift]).all():
        raise CalibrationFailed("no pose of the cylinder fits what this lens sees of it")
    return Pose.from_arrays(
        np.asarray(cv2.Rodrigues(turn)[0], np.float64), np.asarray(shift[:, 0], np.float64)
    )


def _pose_of(view: BoardView, fit: ViewFit, start: Intrinsics) -> Pose:
    """Return the pose of a board for a lens without distortion."""
    if fit.matrix.shape == (3, 3):
        return pose_from_homography(fit.matrix, start)
    return seen_pose(start, view.in_space[fit.kept], view.pixel[fit.kept])


def _fisheyes(
    usable: Sequence[tuple[BoardView, ViewFit]], size: tuple[int, int]
) -> list[tuple[Intrinsics, list[Pose]]]:
    """Return the fisheyes without further distortion in which boards are flattest, with the boards' poses."""
    columns, rows = size
    found = []
    for guess in _WIDE_GUESSES:
        start = Intrinsics(
            guess * columns, guess * columns, 0.5 * (columns - 1), 0.5 * (rows - 1), fisheye=1.0
        )
        try:
            poses = [seen_pose(start, view.in_space, view.pixel) for view, _ in usable]
        except CalibrationFailed:
            continue
        off = [
            np.linalg.norm(view.pixel - project(start, pose, view.in_space), axis=1)
            for (view, _), pose in zip(usable, poses, strict=True)
        ]
        if min(int(np.isfinite(one).sum()) for one in off) < _FEWEST_POINTS:
            continue
        every = np.concatenate(off)
        found.append((float(np.median(np.where(np.isfinite(every), every, np.inf))), start, poses))
    found.sort(key=lambda one: one[0])
    return [(start, poses) for _, start, poses in found[:_TRIED]]


def as_rational(fisheye: Intrinsics, reach: float) -> Intrinsics:
    """Return the rational lens that is nearest to a fisheye up to a normalised radius, by least squares."""
    r = np.linspace(0.0, reach, _RADII + 1)[1:]
    s = distort(replace(fisheye, skew=0.0), np.stack([r, 0.0 * r], axis=-1))[:, 0] / r
    powers = (r[:, None] / reach) ** [2, 4, 6]
    # s (1 + k4 r^2 + ...) = 1 + k1 r^2 + ... is linear in all six.
    terms = np.concatenate([powers, -s[:, None] * powers], axis=1)
    k = np.linalg.lstsq(terms, s - 1.0, rcond=1e-10)[0] / np.tile(reach ** np.array([2.0, 4.0, 6.0]), 2)
    above = dict(zip(("k1", "k2", "k3"), map(float, k[:3]), strict=True))
    below = dict(zip(("k4", "k5", "k6"), map(float, k[3:]), strict=True))
    return replace(fisheye, fisheye=0.0, **above, **below)


def start_sensor(
    name: str,
    usable: Sequence[tuple[BoardView, ViewFit]],
    size: tuple[int, int],
    held: Mapping[str, float],
    model: Model = "plain",
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
    model
        Of its lens.

    Raises
    ------
    CalibrationFailed
        When it has no usable view, or when the views do not tell its focal length to 5 %: the board is
        nearly parallel to the image in all of them.

    Notes
    -----
    A plain lens as Zhang 2000. A fisheye from the focal length that makes boards flattest; a rational lens
    from whichever of both fits better.
    """
    if not usable:
        raise CalibrationFailed(
            f"{name} saw no board that can be used: check that it is lit and in focus there"
        )
    notes = []
    views = _Views(tuple(usable), size, dict(held))
    best = views.plain() if model == "plain" else views.bent(model)
    if "cx" in views.free and max(best.lens_sigma[2:4]) > _CENTRE_LIMIT * size[0]:
        notes.append(
            f"the principal point of {name} was held in the middle of the image: its views leave it open by "
            f"{max(best.lens_sigma[2:4]):.3g} px"
        )
        best = views.centred(best, model)
    _check_focal(name, best, [view.pose for view, _ in usable])
    if len(usable) == 1 and "cx" not in views.free:
        notes.append(f"{name} saw one pose: its principal point was held in the middle of the image")
    return _own(best, usable, tuple(notes))


@dataclass(frozen=True)
class _Views:
    """The views of one sensor, and what of it is held."""

    usable: tuple[tuple[BoardView, ViewFit], ...]
    size: tuple[int, int]
    held: dict[str, float]

    @property
    def free(self) -> list[str]:
        # A view of a cylinder has depth, and tells as much as two of a plane.
        return _free(sum(1 if isinf(view.radius_mm) else 2 for view, _ in self.usable), self.held)

    @property
    def seen(self) -> list[SeenPoints]:
        return [SeenPoints(view.in_space, view.pixel, view.sigma_px) for view, _ in self.usable]

    def plain(self) -> RefinedSensor:
        """Return the best plain lens."""
        seen, trusted = self.seen, [fit.kept for _, fit in self.usable]
        best = None
        for candidate in _candidates([fit for _, fit in self.usable], self.size, False):
            start = replace(candidate, **self.held)
            poses = [_pose_of(view, fit, start) for view, fit in self.usable]
            # Without the principal point at first: a poor focal length would drag it far away.
            near = refine_sensor(
                seen,
                start,
                poses,
                free=_free(1, self.held),
                square_pixels=True,
                trusted=trusted,
                refuse=False,
            )
            square = len(self.usable) < 3
            full = refine_sensor(
                seen, near.intrinsics, near.poses, free=self.free, square_pixels=square, trusted=trusted
            )
            if best is None or full.scale < best.scale:
                best = full
        assert best is not None
        return best

    def bent(self, model: Model) -> RefinedSensor:
        """Return the best fisheye or rational lens; homographies say nothing of which points are right."""
        seen, square = self.seen, len(self.usable) < 3
        richer = [
            n
            for n in LENS
            if n not in fixed_by_default(model) and n not in self.held and n not in ("cx", "cy")
        ]
        richer += [n for n in ("cx", "cy") if n in self.free]
        found = [self.plain()] if model == "rational" else []
        for guess, poses in _fisheyes(self.usable, self.size):
            start = replace(guess, **(self.held if model == "fisheye" else {}))
            near = refine_sensor(
                seen, start, poses, free=_free(1, self.held), square_pixels=True, refuse=False
            )
            found.append(
                refine_sensor(seen, near.intrinsics, near.poses, free=self.free, square_pixels=square)
            )
        if not found:
            raise CalibrationFailed(
                "no focal length of a fisheye makes the views of the board those of a plane: check which "
                "point is which"
            )
        best = min(found, key=lambda one: one.scale)
        if model == "fisheye":
            return best
        start = best.intrinsics
        if start.fisheye:
            flat = [
                p.matrix() @ s.point.T + np.array(p.translation)[:, None]
                for p, s in zip(best.poses, seen, strict=True)
            ]
            reach = max(
                float(np.max(np.hypot(x[0], x[1]) / x[2], where=x[2] > 0.0, initial=0.0)) for x in flat
            )
            start = replace(as_rational(start, reach), **self.held)
        full = refine_sensor(seen, start, best.poses, free=richer, square_pixels=square)
        return min((full, *(one for one in found if not one.intrinsics.fisheye)), key=lambda one: one.scale)

    def centred(self, found: RefinedSensor, model: Model) -> RefinedSensor:
        """Return the sensor with its principal point in the middle of the image."""
        free = [n for n in self.free if n not in ("cx", "cy")]
        centre = (0.5 * (self.size[0] - 1), 0.5 * (self.size[1] - 1))
        if model != "plain":
            start = replace(found.intrinsics, cx=centre[0], cy=centre[1])
            return refine_sensor(self.seen, start, found.poses, free=free, square_pixels=True)
        nearest = _candidates([f for _, f in self.usable], self.size, True)[0]
        start = replace(Intrinsics(nearest.fx, nearest.fy, *centre), **self.held)
        poses = [_pose_of(view, fit, start) for view, fit in self.usable]
        trusted = [fit.kept for _, fit in self.usable]
        return refine_sensor(self.seen, start, poses, free=free, square_pixels=True, trusted=trusted)


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
    usable: Sequence[tuple[BoardView, ViewFit]],
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
    usable: Sequence[tuple[BoardView, ViewFit]],
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
            v.in_space @ board_poses[v.pose].matrix().T + board_poses[v.pose].translation, v.pixel, v.sigma_px
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
