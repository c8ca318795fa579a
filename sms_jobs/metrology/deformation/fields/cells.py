"""Fields averaged over small squares of pixels, so that what looks far looks at few of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats


@dataclass(frozen=True)
class Cells:
    """Means over small squares of pixels: weight (n pixels), place in the image, position, displacement.

    `tangents` (2, 3, ..) are steps of the surface about a square along columns and rows, and `normal` is its
    normal; each of length 0 where it is unknown.
    """

    side: int
    labels: NDArray[np.int32]
    weight: Floats
    place: Floats
    xyz: Floats
    displacement: Floats
    covariance: Floats
    tangents: Floats
    normal: Floats


def cell_means(
    xyz: Floats, displacement: Floats, covariance: Floats, labels: NDArray[np.int32], side: int
) -> Cells:
    """Average fields over squares of `side` x `side` pixels, each over the pixels of one region.

    `labels` is 0 for every pixel that is not to be used. A square with several regions stands for the
    largest of them, which has the smallest label.
    """
    rows, columns = labels.shape
    padding = ((0, -rows % side), (0, -columns % side))

    def squares(field: NDArray[Any]) -> NDArray[Any]:
        padded = np.pad(field, padding)
        return padded.reshape(padded.shape[0] // side, side, -1, side).swapaxes(1, 2)

    pieces = squares(labels)
    own = np.where(pieces > 0, pieces, np.iinfo(np.int32).max).min(axis=(2, 3))
    member = (pieces == own[..., None, None]) & (pieces > 0)
    weight = member.sum(axis=(2, 3)).astype(np.float64)
    divisor = np.maximum(weight, 1.0)

    def mean(field: NDArray[Any]) -> Floats:
        inside = np.where(member, squares(field), 0.0)
        return np.asarray(inside.sum(axis=(2, 3)) / divisor, dtype=np.float64)

    row, column = np.mgrid[0:rows, 0:columns]
    own_label = np.where(weight > 0, own, 0).astype(np.int32)
    position = np.stack([mean(component) for component in xyz])
    tangents = tangents_of(position, own_label)
    return Cells(
        side,
        own_label,
        weight,
        np.stack([mean(column), mean(row)]),
        position,
        np.stack([mean(component) for component in displacement]),
        np.stack([mean(component) for component in covariance]),
        tangents,
        normals_of(tangents),
    )


def tangents_of(position: Floats, labels: NDArray[np.int32]) -> Floats:
    """Return steps (2, 3, rows, columns) along columns and rows of a surface of cells.

    A tangent is the step between the neighbours on both sides, or from the cell itself to the only one; 0
    where a cell has none.
    """
    tangents = []
    for axis in (2, 1):
        forward, backward = np.roll(position, -1, axis), np.roll(position, 1, axis)
        ahead = (np.roll(labels, -1, axis - 1) == labels) & (labels > 0)
        behind = (np.roll(labels, 1, axis - 1) == labels) & (labels > 0)
        last: tuple[Any, ...] = (np.s_[:],) * (axis - 1)
        ahead[(*last, -1)] = False
        behind[(*last, 0)] = False
        step = np.where(ahead, forward, position) - np.where(behind, backward, position)
        tangents.append(np.where(ahead | behind, step, 0.0))
    return np.stack(tangents)


def normals_of(tangents: Floats) -> Floats:
    """Return unit normals (3, rows, columns) of a surface from its tangents, 0 where a cell has not both."""
    normal = np.cross(tangents[1], tangents[0], axis=0)
    length = np.linalg.norm(normal, axis=0)
    return np.asarray(np.where(length > 0.0, normal / np.where(length > 0.0, length, 1.0), 0.0))
