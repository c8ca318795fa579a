"""How wide the spots are that two cameras show of a point, from what matched subsets leave over."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    Matches,
    MatchSettings,
    PreparedImages,
    Spots,
)
from sms_jobs.metrology.deformation.matching.shape_functions import shifted
from sms_jobs.metrology.deformation.matching.subsets import RIM
from sms_jobs.metrology.images.spline import KERNEL_CODE, PADDING, spline_values

_SIGMA = 0.5  # px^2 that a lens may well add to a spot
_MOST = 64  # subsets, so that their pixels fit in memory and take no time
_CERTAIN = 1e-6  # of the texture's variance: less is not held for what is left over


def measured_spots(
    images: PreparedImages, x: Ints, y: Ints, found: Matches, settings: MatchSettings
) -> Spots:
    """Return the spots that explain best what the subsets about some points leave over.

    Parameters
    ----------
    images
        Of two cameras, with the least spots that they can have: those of filter and pixels.
    x, y, found
        The points (n,) and their matches.
    settings
        Of the subsets.

    Returns
    -------
    Variances in px^2. Where both cameras see the specimen alike they cannot be told apart, and need not be:
    then lenses are taken for as good as they can be.

    Notes
    -----
    Least squares in what either spot adds to f: half of its variance times second derivatives (see
    `match_points`), which are at right angles to f's slopes but for chance. What a lens adds is not negative,
    and 0 give or take 0.5 px^2 before anything is seen.
    """
    from scipy.optimize import nnls

    normal, right = np.eye(2) / _SIGMA**2, np.zeros(2)
    some = _whole(images, x, y, found, settings.radius)
    if len(some):
        left, wider = _left_over(images, x[some], y[some], found.warp[some], settings)
        # Images without any noise leave nothing over: that is no certainty.
        weight = 1.0 / np.maximum(np.mean(left**2, axis=1), _CERTAIN * np.var(images.reference))
        normal += np.einsum("n,nip,njp->ij", weight, wider, wider)
        right -= np.einsum("n,nip,np->i", weight, wider, left)
    root = np.linalg.cholesky(normal)
    more, _ = nnls(root.T, np.linalg.solve(root, right))
    return images.spots[0] + float(more[0]), images.spots[1] + float(more[1])


def _offsets(radius: int) -> tuple[Ints, Ints]:
    """Return the places x and y (pixels,) of a whole subset's pixels, row by row."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return x.ravel(), y.ravel()


def _whole(images: PreparedImages, x: Ints, y: Ints, found: Matches, radius: int) -> Ints:
    """Return some matched points whose subsets are whole in both images."""
    last = np.array(images.labels.shape[::-1]) - 1 - RIM
    here = np.stack([x, y], axis=1)
    margin = radius + 1  # slopes are taken between neighbours
    inside = ((here >= RIM + margin) & (here <= last - margin)).all(axis=1)
    points = np.flatnonzero((found.ending == CONVERGED) & inside)
    points = points[:: -(-len(points) // _MOST) or 1]
    dx, dy = _offsets(radius)
    column, row = x[points, None] + dx, y[points, None] + dy
    there = shifted(found.warp[points, None], dx, dy) + np.stack([column, row], axis=-1)
    labels = images.labels[row, column]
    whole = (labels == labels[:, :1]).all(axis=1) & ((there >= RIM) & (there <= last)).all(axis=(1, 2))
    return np.asarray(points[whole])


def _left_over(
    images: PreparedImages, x: Ints, y: Ints, warp: Floats, settings: MatchSettings
) -> tuple[Floats, Floats]:
    """Return what subsets about x, y (n,) leave over, (n, pixels), and `_wider` (n, 2, pixels).

    Of both without what the fit explains: light and the shape function's unknowns.
    """
    dx, dy = _offsets(settings.radius)
    column, row = x[:, None] + dx, y[:, None] + dy
    wider = _wider(images, row, column, warp)
    f = images.reference[row, column] + np.einsum("s,nsp->np", images.spots, wider)
    g = _deformed(images, shifted(warp[:, None], dx, dy) + np.stack([column, row], axis=-1))
    shape = np.stack([np.ones(len(dx)), dx, dy, 0.5 * dx**2, dx * dy, 0.5 * dy**2])
    shape = shape[: (1, 3, 6)[settings.shape_order]]
    light = [np.ones((len(f), 1, len(dx))), (g - g.mean(axis=1, keepdims=True))[:, None]]
    slopes = [slope[row, column][:, None] * shape for slope in (images.gradient_x, images.gradient_y)]
    rows = np.concatenate([*light, *slopes], axis=1)
    values = np.concatenate([f[:, None], wider], axis=1)
    explained = np.linalg.solve(rows @ np.swapaxes(rows, 1, 2), rows @ np.swapaxes(values, 1, 2))
    left = values - np.swapaxes(explained, 1, 2) @ rows
    return left[:, 0], left[:, 1:]


def _wider(images: PreparedImages, row: Ints, column: Ints, warp: Floats) -> Floats:
    """Return what f (n, pixels) has more per px^2 of spots: less of its own, more of the deformed image's."""
    xx = images.gradient_x[row, column + 1] - images.gradient_x[row, column - 1]
    xy = images.gradient_x[row + 1, column] - images.gradient_x[row - 1, column]
    yy = images.gradient_y[row + 1, column] - images.gradient_y[row - 1, column]
    slope = np.eye(2) + np.stack([warp[:, 1:3], warp[:, 4:6]], axis=1)
    tensor = np.linalg.inv(np.swapaxes(slope, 1, 2) @ slope)[..., None]
    other = tensor[:, 0, 0] * xx + 2.0 * tensor[:, 0, 1] * xy + tensor[:, 1, 1] * yy
    return 0.25 * np.stack([-(xx + yy), other], axis=1)


def _deformed(images: PreparedImages, places: Floats) -> Floats:
    """Return the deformed image's grey levels at places (n, pixels, 2)."""
    px, py = places.reshape(-1, 2).T + PADDING
    column, row = px.astype(np.int64), py.astype(np.int64)
    first = (row - 2) * images.coefficients.shape[1] + column - 2
    values = np.empty(len(px))
    code = KERNEL_CODE[images.interpolant]
    spline_values(images.coefficients, code, len(px), first, px - column, py - row, values)
    return values.reshape(places.shape[:2])
