"""One field from several pairs, and one surface from several cameras (thesis section 5.2.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.geometry.transforms import pack

CONTRADICTION = 6.0
"""Deviations of their difference: pairs that differ by more cannot both be right."""
_DIAGONAL = (0, 3, 5)  # of a packed symmetric tensor
_LEAST_VARIANCE = 1e-18  # a picometre: an exact pair would outweigh any other by infinity
_OUTLIER = 5.0  # sigmas: pairs that differ by more see different things, and do not tell of their noise
_LEAST_TOGETHER = 100  # pixels that two pairs must have in common to tell how their errors go together


@dataclass(frozen=True)
class Merged:
    """Pairs of one camera taken together.

    Attributes
    ----------
    value
        (3, rows, columns); NaN where no pair has one.
    covariance
        (6, rows, columns), packed XX, XY, XZ, YY, YZ, ZZ.
    contributors
        (rows, columns), number of pairs that gave a value.
    discrepancy_rms
        Rms length of the difference between pairs where several have a value; NaN where none do.
    discrepancy
        (rows, columns), the same at each pixel (thesis Fig. 65).
    """

    value: Floats
    covariance: Floats
    contributors: NDArray[np.uint8]
    discrepancy_rms: float
    discrepancy: Floats


def _variance(value: NDArray[np.floating], covariance: NDArray[np.floating]) -> Floats:
    """Return the trace of the covariance, (rows, columns), at least a picometre's; NaN without a value."""
    variance = np.sum([covariance[i] for i in _DIAGONAL], axis=0, dtype=np.float64)
    return np.where(np.isfinite(value).all(axis=0), np.maximum(variance, _LEAST_VARIANCE), np.nan)


def _weights(variances: Sequence[Floats]) -> Floats:
    """Return inverse variances (pairs, rows, columns) over their sum; NaN where no pair has a value."""
    weights = np.array([np.where(np.isfinite(v), 1.0 / v, 0.0) for v in variances])
    total = weights.sum(axis=0)
    return np.asarray(weights / np.where(total > 0.0, total, np.nan))


def weights_of_pairs(
    values: Sequence[NDArray[np.floating]], covariances: Sequence[NDArray[np.floating]]
) -> Floats:
    """Return the weights (pairs, rows, columns) of `merge_by_variance`; NaN where no pair has a value."""
    return _weights([_variance(v, c) for v, c in zip(values, covariances, strict=True)])


def correlation_of_pairs(
    values: Sequence[NDArray[np.floating]], covariances: Sequence[NDArray[np.floating]]
) -> Floats:
    """Return how far the errors of pairs go together, from how far the pairs differ.

    Pairs of one camera match the same subsets of the same texture, so what a subset gets wrong beyond the
    camera's noise, both get wrong alike.

    Parameters
    ----------
    values, covariances
        As of `merge_by_variance`.

    Returns
    -------
    (pairs, pairs): coefficients of correlation, 0 .. 1, and 1 on the diagonal.

    Notes
    -----
    With v the traces of the stated covariances and d the difference of two pairs,
    E |d|^2 = v_a + v_b - 2 rho sqrt(v_a v_b), which is solved for rho over all pixels that both have. It is
    as good as the stated variances are. Errors that seem opposed, and those of pairs with fewer than 100
    pixels in common, count as independent.
    """
    variances = [_variance(v, c) for v, c in zip(values, covariances, strict=True)]
    correlation = np.eye(len(values))
    for a in range(len(values)):
        for b in range(a + 1, len(values)):
            square = np.sum((values[a] - values[b]) ** 2, axis=0)
            expected = variances[a] + variances[b]
            inliers = square <= _OUTLIER**2 * expected  # False where one of them has no value
            if np.count_nonzero(inliers) < _LEAST_TOGETHER:
                continue
            shared = float(np.sum(expected[inliers] - square[inliers]))
            most = 2.0 * float(np.sum(np.sqrt(variances[a][inliers] * variances[b][inliers])))
            correlation[a, b] = correlation[b, a] = np.clip(shared / most, 0.0, 1.0)
    return correlation


def merge_by_variance(
    values: Sequence[NDArray[np.floating]],
    covariances: Sequence[NDArray[np.floating]],
    correlation: Floats | None = None,
) -> Merged:
    """Take the mean of a vector field over pairs, weighted by inverse variance.

    Parameters
    ----------
    values
        Of each pair: (3, rows, columns); NaN where it has none.
    covariances
        Of each pair: (6, rows, columns), in the square of the values' unit.
    correlation
        (pairs, pairs), how far the errors of pairs go together: see `correlation_of_pairs`. None for errors
        that do not.

    Notes
    -----
    The weight is the inverse of the covariance's trace, which no rotation of the frame changes; errors of
    the pairs of one camera point along the same rays, so little is lost against full matrices. Equal
    variances give thesis Eq. (4.1). Two pairs with weights w, traces v and correlation rho add
    2 w_a w_b rho sqrt(v_a v_b) (C_a / v_a + C_b / v_b) / 2 to the sum of w^2 C.
    """
    shape = values[0].shape[1:]
    variances = [_variance(v, c) for v, c in zip(values, covariances, strict=True)]
    weights = _weights(variances)
    used = weights > 0.0
    mean = np.zeros((3, *shape))
    spread = np.zeros((6, *shape))
    for weight, value, covariance in zip(weights, values, covariances, strict=True):
        mean += np.where(weight > 0.0, weight * value, 0.0)
        spread += np.where(weight > 0.0, weight**2 * covariance, 0.0)
    if correlation is not None:
        _add_shared(spread, weights, variances, covariances, correlation)
    contributors = used.sum(axis=0).astype(np.uint8)
    mean[:, contributors == 0] = np.nan
    spread[:, contributors == 0] = np.nan
    squares, differences = np.zeros(shape), np.zeros(shape, dtype=np.int64)
    for a in range(len(values)):
        for b in range(a + 1, len(values)):
            both = used[a] & used[b]
            squares[both] += np.sum((values[a][:, both] - values[b][:, both]) ** 2, axis=0)
            differences += both
    total_differences = int(differences.sum())
    rms = float(np.sqrt(squares.sum() / total_differences)) if total_differences else float("nan")
    local = np.sqrt(squares / np.where(differences > 0, differences, np.nan))
    return Merged(mean, spread, contributors, rms, local)


def contradictions(
    values: Sequence[NDArray[np.floating]],
    covariances: Sequence[NDArray[np.floating]],
    further: Sequence[NDArray[np.floating]],
) -> Floats:
    """Return the covariance of the mean from pairs that contradict each other; zero where none do.

    Parameters
    ----------
    values, covariances
        As of `merge_by_variance`.
    further
        Of each pair: (rows, columns), variance that its covariance does not have, as of the calibration.

    Returns
    -------
    (6, rows, columns), to be added to the covariance of `merge_by_variance`.

    Notes
    -----
    Which of them is right nobody knows: with weights w_i and residuals r_i it is the sum of w_i r_i r_i^T,
    where its trace is more than `CONTRADICTION` squared times what was to be expected.
    """
    variances = [_variance(v, c) for v, c in zip(values, covariances, strict=True)]
    weights = _weights(variances)
    shape = weights[0].shape
    residuals = np.where(weights[:, None] > 0.0, np.asarray(values), 0.0)
    residuals -= np.where(weights[:, None] > 0.0, (weights[:, None] * residuals).sum(axis=0), 0.0)
    expected = np.zeros(shape)
    stated = [v + np.nan_to_num(more) for v, more in zip(variances, further, strict=True)]
    for a in range(len(values)):
        for b in range(a + 1, len(values)):
            both = (weights[a] > 0.0) & (weights[b] > 0.0)
            expected[both] += (weights[a] * weights[b] * (stated[a] + stated[b]))[both]
    found = np.sum(weights * np.sum(residuals**2, axis=1), axis=0)
    apart = (expected > 0.0) & (found > CONTRADICTION**2 * expected)
    spread = np.zeros((6, *shape))
    some = residuals[:, :, apart]
    spread[:, apart] = pack(np.einsum("vn,vin,vjn->nij", weights[:, apart], some, some))
    return spread


def _add_shared(
    spread: Floats,
    weights: Floats,
    variances: Sequence[Floats],
    covariances: Sequence[NDArray[np.floating]],
    correlation: Floats,
) -> None:
    """Add to a merged covariance (6, rows, columns) what the errors of pairs have in common."""
    for a in range(len(variances)):
        for b in range(a + 1, len(variances)):
            both = (weights[a] > 0.0) & (weights[b] > 0.0)
            if correlation[a, b] == 0.0 or not both.any():
                continue
            va, vb = variances[a][both], variances[b][both]
            factor = correlation[a, b] * weights[a][both] * weights[b][both] * np.sqrt(va * vb)
            spread[:, both] += factor * (covariances[a][:, both] / va + covariances[b][:, both] / vb)


def combine_labels(maps: Sequence[NDArray[np.int32]]) -> NDArray[np.int32]:
    """Return one label map for several of the same view.

    Parameters
    ----------
    maps
        Of each pair: (rows, columns), 0 where it sees no region.

    Returns
    -------
    (rows, columns): the first map's labels, continued over pixels that only later ones see. A later map's
    region takes the label that it overlaps most, or a new one.
    """
    combined = maps[0].copy()
    for labels in maps[1:]:
        both = (labels > 0) & (combined > 0)
        overlaps = np.zeros((int(labels.max()) + 1, int(combined.max()) + 1), dtype=np.int64)
        np.add.at(overlaps, (labels[both], combined[both]), 1)
        translated = np.argmax(overlaps, axis=1)
        alone = overlaps.sum(axis=1) == 0
        alone[0] = False
        unseen = np.flatnonzero(alone)
        translated[unseen] = combined.max() + 1 + np.arange(len(unseen))
        translated[0] = 0
        combined = np.where(combined > 0, combined, translated[labels]).astype(np.int32)
    return combined


def join_meshes(
    meshes: Sequence[tuple[Floats, NDArray[np.int32]]],
) -> tuple[Floats, NDArray[np.int32], Ints, Ints]:
    """Join the meshes of several cameras, without doubling what an earlier one shows already.

    Parameters
    ----------
    meshes
        Of each camera: vertices (n, 3) in mm and faces (m, 3).

    Returns
    -------
    vertices, faces
        Of the joint mesh.
    camera, vertex
        (vertices,): which mesh each vertex comes from, and its index there.

    Notes
    -----
    A face is left out when all its corners lie nearer to a vertex of an earlier camera than that camera's
    points lie apart (the median edge), so views overlap by about one pixel along their seams.
    """
    kept: list[tuple[Floats, Ints, Ints]] = []
    for vertices, faces in meshes:
        alone = np.ones(len(faces), dtype=bool)
        for points, triangles, _ in kept:
            if len(triangles) and len(faces):
                edge = np.linalg.norm(points[triangles[:, 0]] - points[triangles[:, 1]], axis=1)
                distance, _ = cKDTree(points).query(vertices, distance_upper_bound=float(np.median(edge)))
                alone &= ~np.isfinite(distance)[faces].all(axis=1)
        used, inverse = np.unique(faces[alone], return_inverse=True)
        kept.append((vertices[used], inverse.reshape(-1, 3), used.astype(np.int64)))
    offsets = np.cumsum([0, *(len(points) for points, _, _ in kept)])
    return (
        np.concatenate([points for points, _, _ in kept]),
        np.concatenate([t + o for (_, t, _), o in zip(kept, offsets, strict=False)]).astype(np.int32),
        np.repeat(np.arange(len(kept)), np.diff(offsets)),
        np.concatenate([used for _, _, used in kept]),
    )
