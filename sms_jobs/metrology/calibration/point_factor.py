"""By how much points, and what is made of them, lie elsewhere because sensors are known only so well.

An error of the calibration moves all points together. It is therefore kept as a factor: for a point the
derivatives by the parameters times a square root of their covariance, 3 x r, whose r columns mean the same
for every point of every view. Whatever is linear in points, such as a difference or a mean, has that of the
factors for its own, and the sum of its squares for its variance: what is common cancels, or stays, as it does
in truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.bundle.covariance import point_jacobian
from sms_jobs.metrology.calibration.sensor_derivatives import project_with_derivatives, ray_derivatives
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR, Camera, projection_jacobian
from sms_jobs.metrology.geometry.transforms import transform
from sms_jobs.metrology.phase.patterns import direction

_ROUNDING = 1e-14
"""Of the largest variance of a correlation matrix: what is below has none but for rounding."""


@dataclass(frozen=True)
class KnownView:
    """A view, and how well its sensors are known.

    Attributes
    ----------
    sensors
        The reference camera and its partners.
    calibration
        What names their calibration: columns of the roots of one mean the same.
    root
        (parameters, r), a square root of the covariance of the sensors' parameters, in rad, mm and px.
    orientations_rad
        Of the fringes, where the partner is a projector; empty for cameras.
    own
        How many of the last columns mean something for this view alone.
    """

    sensors: tuple[Camera, ...]
    calibration: str
    root: Floats
    orientations_rad: tuple[float, ...] = ()
    own: int = 0

    def with_own(self, columns: Floats) -> KnownView:
        """Return the view with columns (parameters, k) more that mean something for it alone."""
        root = np.concatenate([self.root, columns], axis=1)
        return replace(self, root=root, own=self.own + columns.shape[1])


def square_root(covariance: Floats) -> Floats:
    """Return L (p, r) with L L^T = covariance (p, p), r its rank; what is held fixed has rows of zeros.

    From the eigenvectors of the correlation matrix, because parameters have different units.
    """
    sigma = np.sqrt(np.diag(covariance))
    free = sigma > 0.0
    root = np.zeros((len(covariance), 0))
    if not free.any():
        return root
    values, vectors = np.linalg.eigh(covariance[np.ix_(free, free)] / np.outer(sigma[free], sigma[free]))
    some = values > _ROUNDING * values[-1]
    root = np.zeros((len(covariance), int(some.sum())))
    root[free] = sigma[free, None] * vectors[:, some] * np.sqrt(values[some])
    return root


def economical(view: KnownView) -> KnownView:
    """Return a view with no more columns than it has parameters, which mean something for its points alone.

    By the singular values of its root; the same for all states of one calibration.
    """
    common, own = np.split(view.root, [view.root.shape[1] - view.own], axis=1)
    if common.shape[1] <= len(common):
        return view
    left, sizes, _ = np.linalg.svd(common, full_matrices=False)
    return replace(view, root=np.concatenate([left * sizes, own], axis=1))


def turns(sensors: tuple[Camera, ...]) -> Floats:
    """Return what sensors are uncertain by that have turned, (parameters, 2 per sensor).

    Each about both axes of its image, by the angle that moves the image of the first partner by
    1 px / sqrt(2): what that sees of the reference camera's rays is then uncertain by a pixel of its own,
    however fine those of the camera are.
    """
    columns = np.zeros((PER_SENSOR * len(sensors), 2 * len(sensors)))
    partner = sensors[1].intrinsics
    angle = 1.0 / np.sqrt(2.0 * partner.fx * partner.fy)
    for number, sensor in enumerate(sensors):
        for axis, turn in enumerate(angle * np.eye(3)[:2]):
            # About its own centre, while R <- exp([r]x) R turns it about the world's origin.
            shift = np.cross(turn, sensor.pose.translation)
            at = PER_SENSOR * number
            columns[at : at + PER_POSE, 2 * number + axis] = np.concatenate([turn, shift])
    return columns


def point_factor(view: KnownView, points: Floats) -> Floats:
    """Return by how much points move with each column of a calibration's root.

    Parameters
    ----------
    view
        What measures them.
    points
        (n, 3) in mm.

    Returns
    -------
    (n, 3, r) in mm; NaN where a sensor does not see a point.

    Notes
    -----
    The pixels are held, of the reference camera and of its partners. With fringes of two orientations the
    point is where two rays are closest (thesis Fig. 12), with those of one where the camera's ray meets a
    surface of constant phase, and of several cameras on the reference camera's ray where it fits all images
    best, with matches that are equally good along x and y and in all images: error propagation by the
    implicit function theorem.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    if len(view.orientations_rad) > 1:
        camera, projector = ((one.intrinsics, one.pose) for one in view.sensors)
        return np.asarray(point_jacobian(camera, projector, points) @ view.root)
    return np.asarray(_on_the_ray(view, points) @ view.root)


def _on_the_ray(view: KnownView, points: Floats) -> Floats:
    """Return d(point)/d(parameters), (n, 3, p), of points whose depth alone is found in other images.

    Unknown are the depth z and, of cameras, by how much the reference camera's noise has moved the matches of
    all partners, in px, with as much weight as what a partner sees: see `geometry.several_cameras.meet_rays`.
    """
    reference, *partners = view.sensors
    own = reference.intrinsics, reference.pose
    depth = transform(reference.pose, points)[:, 2]
    ray, by_ray, by_hole = ray_derivatives(*own, points)
    moved = by_hole + depth[:, None, None] * by_ray
    size = PER_SENSOR * len(view.sensors)
    normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, size))
    normal[:, 1, 1] = normal[:, 2, 2] = 1.0
    # A step of one pixel of the reference image, at the same depth.
    plane = reference.pose.matrix()[:2].T
    beside = plane @ np.linalg.inv(projection_jacobian(*own, points) @ plane)
    steps = np.concatenate([ray[:, :, None], beside], axis=2)
    for number, partner in enumerate(partners, start=1):
        pixels, slopes, rows = _seen_by_partner(partner, number, points, moved, size)
        seen = (_inside(partner, pixels) | (len(partners) == 1))[:, None, None]
        by_step = slopes @ steps
        if view.orientations_rad:
            across = np.array([direction(view.orientations_rad[0])])
            by_step, rows = across @ by_step * [1.0, 0.0, 0.0], across @ rows
        normal += np.where(seen, by_step.transpose(0, 2, 1) @ by_step, 0.0)
        right += np.where(seen, by_step.transpose(0, 2, 1) @ rows, 0.0)
    known = normal[:, 0, 0] > 0.0
    normal[~known] = np.eye(3)
    moved[~known] = np.nan
    along = -np.linalg.solve(normal, right)[:, 0]
    rows = ray[:, :, None] * along[:, None, :]
    rows[:, :, :PER_SENSOR] += moved
    rows[~known] = np.nan
    return rows


def _seen_by_partner(
    partner: Camera, number: int, points: Floats, moved: Floats, size: int
) -> tuple[Floats, Floats, Floats]:
    """Return pixels (n, 2) of points in a partner, their slopes by the points and by all `size` parameters.

    `moved` (n, 3, parameters) is how the points move with the reference camera's, whose pixels are held.
    """
    pixels, by_pose, by_lens = project_with_derivatives(partner.intrinsics, partner.pose, points)
    slopes = projection_jacobian(partner.intrinsics, partner.pose, points)
    rows = np.zeros((len(points), 2, size))
    rows[:, :, :PER_SENSOR] = slopes @ moved
    at = PER_SENSOR * number
    rows[:, :, at : at + PER_POSE] = by_pose
    rows[:, :, at + PER_POSE : at + PER_SENSOR] = by_lens
    return pixels, slopes, rows


def line_sigma_px(view: KnownView, partner: int, points: Floats) -> Floats:
    """Return how well it is known how far beside the images of their rays a camera sees points.

    Parameters
    ----------
    view
        Of cameras.
    partner
        Which of its sensors sees the points, from 1 on.
    points
        (n, 3) in mm.

    Returns
    -------
    (n,) in px: the standard deviation, by the calibration alone, of the distance of a point's image in the
    partner from that of the reference camera's ray through it (its epipolar line; with distortion, the
    tangent of that curve); NaN behind a camera.

    Notes
    -----
    The reference camera's pixel is held. What moves along the line is depth, and no matter here: n J L, with
    n across the line, J the derivatives of the image by the parameters and L the view's root.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    reference = view.sensors[0]
    own = reference.intrinsics, reference.pose
    ray, by_ray, by_hole = ray_derivatives(*own, points)
    moved = by_hole + transform(reference.pose, points)[:, 2, None, None] * by_ray
    size = PER_SENSOR * len(view.sensors)
    _, slopes, rows = _seen_by_partner(view.sensors[partner], partner, points, moved, size)
    along = (slopes @ ray[:, :, None])[:, :, 0]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    return sigma_of((across[:, None] @ rows)[:, 0] @ view.root)


def _inside(camera: Camera, pixels: Floats) -> Mask:
    """Return which pixels (n, 2) lie in an image."""
    x, y = pixels.T
    with np.errstate(invalid="ignore"):
        inside = (x >= -0.5) & (y >= -0.5) & (x <= camera.columns - 0.5) & (y <= camera.rows - 0.5)
    return np.asarray(inside)


def motion_factor(before: KnownView, after: KnownView, points: Floats, displacement: Floats) -> Floats:
    """Return the factor of the displacement (n, 3) in mm of points (n, 3), (n, 3, r).

    Two states that were measured with one calibration have its errors in common, which cancel but for the way
    between; those of two calibrations count as independent, and each has columns of its own.
    """
    ends = point_factor(after, points + displacement), point_factor(before, points)
    if before.calibration == after.calibration:
        return ends[0] - ends[1]
    return np.concatenate([ends[0], -ends[1]], axis=2)


def sigma_of(factor: Floats) -> Floats:
    """Return the standard deviations (...,) that a factor (..., r) states."""
    return np.asarray(np.sqrt(np.sum(np.square(factor), axis=-1)))
