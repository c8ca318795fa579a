"""The homography between a plane and its image, with outliers refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.arrays import Floats, Mask

_FEWEST = 4
_SAMPLES = 128  # with a quarter of outliers the chance that no sample is clean is 1e-21
_REWEIGHTINGS = 4
_REFUSED_BEYOND = 8.0  # robust standard deviations: distortion, which a homography lacks, must not refuse
_LINE = 1e-3  # spread across over spread along, below which points are on a line


@dataclass(frozen=True)
class HomographyFit:
    """A homography and what it was fitted to.

    Attributes
    ----------
    matrix
        (3, 3): image = matrix @ (x, y, 1), divided by its last component, which is positive at the points.
    kept
        (n,) which points it was fitted to.
    rms_px
        Root mean square of their residuals in the image, each coordinate.
    """

    matrix: Floats
    kept: Mask
    rms_px: float


def apply_homography(matrix: Floats, points: Floats) -> Floats:
    """Return the images (n, 2) of points (n, 2)."""
    lifted = points @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(lifted[:, :2] / lifted[:, 2:])


def normalising(points: Floats) -> Floats:
    """Return the (d + 1, d + 1) similarity that brings points (n, d) to mean 0 and rms distance sqrt(d).

    Hartley 1997.
    """
    dimensions = points.shape[1]
    mean = points.mean(axis=0)
    scale = np.sqrt(dimensions / np.mean(np.sum((points - mean) ** 2, axis=1)))
    result = np.diag([*np.full(dimensions, scale), 1.0])
    result[:dimensions, dimensions] = -scale * mean
    return result


def flatness(points: Floats) -> float:
    """Return the smallest over the largest spread of points (n, d): 0 on a line (d = 2) or plane (d = 3)."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(spread[-1] / spread[0]) if spread[0] > 0.0 else 0.0


def _rows(source: Floats, target: Floats) -> Floats:
    """Return the (..., 2 n, 9) equations of thesis refs. 83, 84 for normalised points (..., n, 2)."""
    lifted = np.concatenate([source, np.ones_like(source[..., :1])], axis=-1)
    zero = np.zeros_like(lifted)
    first = np.concatenate([lifted, zero, -target[..., :1] * lifted], axis=-1)
    second = np.concatenate([zero, lifted, -target[..., 1:] * lifted], axis=-1)
    return np.concatenate([first, second], axis=-2)


def _least_squares(source: Floats, target: Floats, weight: Floats) -> Floats:
    """Fit normalised points by weighted DLT; reweighted until residuals are those of the image."""
    rows = _rows(source, target)
    depth = np.ones(len(source))
    for _ in range(_REWEIGHTINGS):
        _, _, v = np.linalg.svd(rows * np.tile(weight / depth, 2)[:, None], full_matrices=False)
        h = v[-1].reshape(3, 3)
        depth = source @ h[2, :2] + h[2, 2]
        if depth.mean() < 0.0:
            h, depth = -h, -depth
        if depth.min() <= 0.0:  # the line at infinity runs through the points: no view of a board
            break
    return np.asarray(h)


def _least_median(source: Floats, target: Floats) -> Floats:
    """Return the residuals (n,) of the sample of four points whose homography has the least median."""
    generator = np.random.default_rng(len(source))  # the same samples for the same number of points
    samples = np.argsort(generator.random((_SAMPLES, len(source))), axis=1)[:, :_FEWEST]
    _, _, v = np.linalg.svd(_rows(source[samples], target[samples]))
    h = v[:, -1].reshape(-1, 3, 3)
    lifted = np.einsum("sij,nj->sni", h, np.concatenate([source, np.ones((len(source), 1))], axis=1))
    with np.errstate(all="ignore"):
        distance = np.linalg.norm(lifted[..., :2] / lifted[..., 2:] - target, axis=-1)
    distance[~np.isfinite(distance)] = np.inf
    return np.asarray(distance[np.argmin(np.median(distance, axis=1))])


def fit_homography(points: Floats, pixels: Floats, sigma_px: Floats | None = None) -> HomographyFit:
    """Fit the homography of a plane to its image.

    Parameters
    ----------
    points
        (n, 2) on the plane, in mm.
    pixels
        (n, 2), their images.
    sigma_px
        (n,) standard deviations of the images in each direction; equal by default.

    Returns
    -------
    With the points refused that are farther from the homography than 8 robust standard deviations: those of
    the least median of squares, so that nearly half of the points may be wrong.

    Raises
    ------
    InvalidInput
        For arrays that do not fit each other, or values that are not finite.
    CalibrationFailed
        For fewer than 4 points, or points on a line.

    Notes
    -----
    Normalised DLT (Hartley 1997), reweighted so that it minimises the residuals in the image; the least
    median of squares is Rousseeuw 1984.
    """
    points, pixels = np.asarray(points, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    sigma = np.ones(len(points)) if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    if points.shape != (len(points), 2) or pixels.shape != points.shape or sigma.shape != (len(points),):
        raise InvalidInput(
            f"points {points.shape}, pixels {pixels.shape} and sigma {sigma.shape} do not belong together: "
            "give (n, 2), (n, 2) and (n,)"
        )
    if not (np.isfinite(points).all() and np.isfinite(pixels).all() and np.all(sigma > 0.0)):
        raise InvalidInput("points, pixels and standard deviations must be finite, and the latter positive")
    if len(points) < _FEWEST:
        raise CalibrationFailed(f"{len(points)} points of a board are too few: a homography needs {_FEWEST}")
    for what, where in (("board", points), ("image", pixels)):
        if flatness(where) < _LINE:
            raise CalibrationFailed(
                f"the {len(points)} points lie on a line in the {what}: show points that spread over an area"
            )
    to_source, to_target = normalising(points), normalising(pixels)
    source, target = apply_homography(to_source, points), apply_homography(to_target, pixels)
    kept = np.ones(len(points), np.bool_)
    if len(points) > _FEWEST:
        residual = _least_median(source, target) / sigma
        # 1.1774: the median of a Rayleigh distribution. For few points the median is too small, as four of
        # them fit exactly; corrected as in Rousseeuw & Leroy 1987.
        scale = np.median(residual) / 1.1774 * (1.0 + 5.0 / (len(points) - _FEWEST))
        kept = residual <= _REFUSED_BEYOND * max(float(scale), 1e-9)
    if kept.sum() < _FEWEST or flatness(points[kept]) < _LINE:
        kept[:] = True
    h = _least_squares(source[kept], target[kept], 1.0 / sigma[kept])
    matrix = np.linalg.inv(to_target) @ h @ to_source
    matrix /= np.linalg.norm(matrix)
    if points[kept][0] @ matrix[2, :2] + matrix[2, 2] < 0.0:
        matrix = -matrix
    off = apply_homography(matrix, points[kept]) - pixels[kept]
    return HomographyFit(matrix, kept, float(np.sqrt(np.mean(off**2))))
