"""One field from several pairs, and one surface from several cameras (thesis section 5.2.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats: TypeAlias = NDArray[np.float64]

_DIAGONAL = (0, 3, 5)  # of a packed symmetric tensor


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


def merge_by_variance(
    values: Sequence[NDArray[np.floating]], covariances: Sequence[NDArray[np.floating]]
) -> Merged:
    """Take the mean of a vector field over pairs, weighted by inverse variance.

    Parameters
    ----------
    values
        Of each pair: (3, rows, columns); NaN where it has none.
    covariances
        Of each pair: (6, rows, columns), in the square of the values' unit.

    Notes
    -----
    The weight is the inverse of the covariance's trace, which no rotation of the frame changes; errors of
    the pairs of one camera point along the same rays, so little is lost against full matrices. Equal
    variances give thesis Eq. (4.1).
    """
    shape = values[0].shape[1:]
    weights = np.zeros((len(values), *shape))
    for k, (value, covariance) in enumerate(zip(values, covariances, strict=True)):
        variance = np.sum([covariance[i] for i in _DIAGONAL], axis=0, dtype=np.float64)
        known = np.isfinite(value).all(axis=0) & np.isfinite(variance)
        # An exact pair would outweigh any other by infinity: a picometre is exact enough.
        weights[k] = np.where(known, 1.0 / np.maximum(np.where(known, variance, 1.0), 1e-18), 0.0)
    total = weights.sum(axis=0)
    weights /= np.where(total > 0.0, total, np.nan)
    used = weights > 0.0
    mean = np.zeros((3, *shape))
    spread = np.zeros((6, *shape))
    for weight, value, covariance in zip(weights, values, covariances, strict=True):
        mean += np.where(weight > 0.0, weight * value, 0.0)
        spread += np.where(weight > 0.0, weight**2 * covariance, 0.0)
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
) -> tuple[Floats, NDArray[np.int32], NDArray[np.int64], NDArray[np.int64]]:
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
    kept: list[tuple[Floats, NDArray[np.int64], NDArray[np.int64]]] = []
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
