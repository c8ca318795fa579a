"""One specimen seen from two positions of a rig: the rigid motion between them (thesis section 6.2.3).

Points of one view are found in the other by their texture, looked up in both shapes, and laid on each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sms_jobs.errors import MeasurementFailed
from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.calibration.rigid_alignment import align_points, rigid_modes
from sms_jobs.metrology.deformation.fields.averaging import average_in_region
from sms_jobs.metrology.deformation.matching.correlation import (
    MatchSettings,
    Noise,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import GridSettings, is_sure
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import (
    inverse,
    pack,
    rotation_matrix,
    transform,
    turn_covariance,
    unpack,
)
from sms_jobs.metrology.images.interpolation import interpolate_in_region

_FEWEST = 12
_NEIGHBOURS = 24  # pixels of the other view that tell where a point would be seen in it
_FAR = 3.0  # pixel pitches: a point with nothing nearer in the other view is not seen there
_STEP = 4  # px each way over which a view's slopes are taken
_OUTLIER = 4.0  # in units of the scatter: three good points of ten thousand are farther off
_MEDIAN_OF_CHI = 1.5382  # median length of a deviate in three directions, in units of its sigma
_ITERATIONS = 20
_EXACT_MM = 1e-6  # added to every direction: the noise of one pixel's point lies along its ray alone


@dataclass(frozen=True)
class View:
    """What a camera sees of a specimen at rest.

    Attributes
    ----------
    texture
        (rows, columns), in grey levels.
    noise
        Of the texture.
    xyz, covariance
        (3, rows, columns) in mm and (6, rows, columns) in mm^2, in the frame of this position of the rig.
    labels
        (rows, columns), continuous pieces of surface, 0 for none; positions are finite where it is not 0.
    independent
        (6, rows, columns) in mm^2: what of the covariance a mean over pixels makes less; None for all.
    """

    texture: NDArray[np.floating]
    noise: Noise
    xyz: Floats
    covariance: Floats
    labels: NDArray[np.int32]
    independent: Floats | None = None

    def averaged(self, radius: float, threads: int = 1) -> View:
        """Return the view with its positions averaged over a radius in px; where they cannot be, it ends."""
        xyz, covariance = average_in_region(
            self.xyz, self.covariance, self.labels, self.labels > 0, radius, threads, self.independent
        )
        labels = np.where(np.isfinite(xyz).all(axis=0), self.labels, 0).astype(np.int32)
        return replace(self, xyz=xyz, covariance=covariance, labels=labels, independent=None)

    def pitch(self) -> float:
        """Return the median distance in mm between neighbouring pixels of a row."""
        together = (self.labels[:, 1:] == self.labels[:, :-1]) & (self.labels[:, 1:] > 0)
        steps = np.linalg.norm(self.xyz[:, :, 1:] - self.xyz[:, :, :-1], axis=0)[together]
        return float(np.median(steps)) if len(steps) else 1.0


@dataclass(frozen=True)
class CommonPoints:
    """Material points that two views see: `here` and `there` (n, 3) in mm, in the frame of each.

    `covariance_here` and `covariance_there` are (6, n) in mm^2; the match counts as noise of `there`.
    """

    here: Floats
    there: Floats
    covariance_here: Floats
    covariance_there: Floats

    def and_those(self, other: CommonPoints) -> CommonPoints:
        """Return these points and others, of another camera."""
        return CommonPoints(
            np.concatenate([self.here, other.here]),
            np.concatenate([self.there, other.there]),
            np.concatenate([self.covariance_here, other.covariance_here], axis=1),
            np.concatenate([self.covariance_there, other.covariance_there], axis=1),
        )


@dataclass(frozen=True)
class Alignment:
    """The motion that brings one view's frame into another's: x_here = R x_there + T.

    Attributes
    ----------
    pose
        R and T.
    covariance
        (6, 6) of a small turn about the origin of the frame here (rad) and a shift (mm).
    residual
        (n, 3) in mm: R x_there + T - x_here.
    used
        (n,), which points took part.
    scale
        Robust scatter of the residuals in units of what is stated of the points, at least 1.
    rms_mm
        Rms length of the residuals of the points that took part.
    """

    pose: Pose
    covariance: Floats
    residual: Floats
    used: Mask
    scale: float
    rms_mm: float


def common_points(
    here: View, there: View, start: Pose, settings: MatchSettings, grid: GridSettings, threads: int = 1
) -> CommonPoints:
    """Find points of one view in another by their texture, and look them up in both shapes.

    Parameters
    ----------
    here, there
        The views, averaged: see `View.averaged`.
    start
        x_here = R x_there + T, right to about a speckle's radius.
    settings, grid
        Of the subsets, and of what is accepted; points are a subset apart, so that they share no pixel.
    threads
        How many threads to use; the result does not depend on it.

    Notes
    -----
    Where a point of one view would be seen in the other, and with what slopes, follows from the shapes alone:
    a linear fit of the pixel to the position over the nearest points.
    """
    x, y, guess = _expected(here, there, start, 2 * settings.radius + 1)
    images = prepare_images(here.texture, there.texture, here.labels, (here.noise, there.noise))
    found = match_points(images, x, y, guess, settings, threads)
    sure = is_sure(found, grid)
    x, y = x[sure], y[sure]
    end_x, end_y = x + found.warp[sure, 0], y + found.warp[sure, 3]
    place, _, slope = interpolate_in_region(
        there.xyz, there.covariance[:0], there.labels, end_x[None], end_y[None], threads
    )
    rows, columns = there.labels.shape
    row = np.clip(np.rint(end_y), 0, rows - 1).astype(int)
    column = np.clip(np.rint(end_x), 0, columns - 1).astype(int)
    # Neighbouring averages share their noise: between pixels it is no less than at them.
    spread = there.covariance[:, row, column]
    along = slope[:, :, 0] * found.sigma[sure].T[None]
    spread = spread + pack(np.einsum("ian,jan->nij", along, along))
    kept = np.isfinite(place[:, 0]).all(axis=0) & np.isfinite(spread).all(axis=0)
    return CommonPoints(
        here.xyz[:, y, x].T[kept],
        place[:, 0].T[kept],
        here.covariance[:, y, x][:, kept],
        spread[:, kept],
    )


def _expected(here: View, there: View, start: Pose, spacing: int) -> tuple[Ints, Ints, Floats]:
    """Return the points of a grid that the other view should see, and the warps (n, 6) to expect."""
    rows, columns = here.labels.shape
    y, x = (a.ravel() for a in np.mgrid[spacing // 2 : rows : spacing, spacing // 2 : columns : spacing])
    inside = (x >= _STEP) & (y >= _STEP) & (x < columns - _STEP) & (y < rows - _STEP)
    x, y = x[inside], y[inside]
    label = here.labels[y, x]
    same = label > 0
    for dx, dy in ((_STEP, 0), (-_STEP, 0), (0, _STEP), (0, -_STEP)):
        same &= here.labels[y + dy, x + dx] == label
    x, y = x[same], y[same]
    back = inverse(start)
    place = transform(back, here.xyz[:, y, x].T)
    right = here.xyz[:, y, x + _STEP] - here.xyz[:, y, x - _STEP]
    down = here.xyz[:, y + _STEP, x] - here.xyz[:, y - _STEP, x]
    turned = back.matrix() @ (np.stack([right, down], axis=1).reshape(3, -1) / (2.0 * _STEP))
    pixel, slopes, near = _seen_at(there, place)
    gradient = np.einsum("nai,ibn->nab", slopes, turned.reshape(3, 2, -1))
    u, v = pixel[:, 0] - x, pixel[:, 1] - y
    (ux, uy), (vx, vy) = gradient[:, 0].T, gradient[:, 1].T
    guess = np.stack([u, ux - 1.0, uy, v, vx, vy - 1.0], axis=1)
    return x[near], y[near], guess[near]


def _seen_at(view: View, points: Floats) -> tuple[Floats, Floats, Mask]:
    """Return the pixels (n, 2) where a view sees points, their slopes (n, 2, 3) in px / mm, and if it does.

    The slopes along the surface's normal are zero: nothing is known of them, and nothing is needed.
    """
    row, column = np.nonzero(view.labels)
    count = min(_NEIGHBOURS, len(row))
    if len(points) == 0 or count < _NEIGHBOURS:
        none = np.zeros(len(points), dtype=bool)
        return np.zeros((len(points), 2)), np.zeros((len(points), 2, 3)), none
    surface = view.xyz[:, row, column].T
    distance, index = cKDTree(surface).query(points, count)
    near = distance[:, 0] <= _FAR * view.pitch()
    corner = surface[index]
    pixel = np.stack([column, row], axis=1)[index].astype(np.float64)
    middle, centre = corner.mean(axis=1), pixel.mean(axis=1)
    offset = corner - middle[:, None]
    scatter = np.einsum("nki,nkj->nij", offset, offset)
    spread, axes = np.linalg.eigh(scatter)
    plane = axes[:, :, 1:]
    moment = np.einsum("nka,nki,nij->naj", pixel - centre[:, None], offset, plane)
    slopes = np.einsum("naj,nij->nai", moment / np.maximum(spread[:, None, 1:], 1e-30), plane)
    return centre + np.einsum("nai,ni->na", slopes, points - middle), slopes, near


def align_views(points: CommonPoints, start: Pose) -> Alignment:
    """Lay the points of one view on those of another by a rigid motion.

    Parameters
    ----------
    points
        What both views see.
    start
        x_here = R x_there + T, near enough for its rotation to turn the covariances.

    Raises
    ------
    MeasurementFailed
        Fewer than 12 points are left.

    Notes
    -----
    Thesis section 6.2.3 fits by singular values, all points alike. Here each counts by the inverse of its
    covariance, in both frames, by Gauss-Newton steps from that fit; points farther off than four times
    what the median lets expect are left out until the set stays. The covariance is that of the weighted fit
    times the squared scale.
    """
    pose, used = start, np.ones(len(points.here), dtype=bool)
    _enough(used)
    for iteration in range(_ITERATIONS):
        full = unpack(points.covariance_here + turn_covariance(pose.matrix(), points.covariance_there))
        weight = np.linalg.inv(full + _EXACT_MM**2 * np.eye(3))
        if iteration == 0:
            pose = _robust_start(points, pose)
        moved = transform(pose, points.there)
        residual = moved - points.here
        length = np.sqrt(np.einsum("ni,nij,nj->n", residual, weight, residual))
        scale = max(1.0, float(np.median(length[used])) / _MEDIAN_OF_CHI)
        last, used = used, length <= _OUTLIER * scale
        _enough(used)
        modes = rigid_modes(moved[used])
        normal = np.einsum("nia,nij,njb->ab", modes, weight[used], modes)
        step = -np.linalg.solve(normal, np.einsum("nia,nij,nj->a", modes, weight[used], residual[used]))
        pose = _moved(pose, step)
        if np.array_equal(last, used) and np.linalg.norm(rigid_modes(moved) @ step, axis=1).max() < 1e-9:
            break
    residual = transform(pose, points.there) - points.here
    rms = float(np.sqrt(np.mean(np.sum(residual[used] ** 2, axis=1))))
    return Alignment(pose, scale**2 * np.linalg.inv(normal), residual, used, scale, rms)


def _enough(used: Mask) -> None:
    count = np.count_nonzero(used)
    if count < _FEWEST:
        raise MeasurementFailed(
            f"the two views have {count} points in common and their alignment needs {_FEWEST}: let them "
            "overlap by more, or look at the texture of the overlap"
        )


def _robust_start(points: CommonPoints, pose: Pose) -> Pose:
    """Return the fit by singular values to the half of the points that fit best, after a few rounds."""
    for _ in range(5):
        off = np.linalg.norm(transform(pose, points.there) - points.here, axis=1)
        kept = off <= np.median(off)
        pose = align_points(points.there[kept], points.here[kept])
    return pose


def _moved(pose: Pose, step: Floats) -> Pose:
    turn = rotation_matrix(step[:3])
    return Pose.from_arrays(turn @ pose.matrix(), turn @ np.array(pose.translation) + step[3:])
