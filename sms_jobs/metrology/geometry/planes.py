"""Vectors and covariances of a plane, as those of the space that it lies in."""

from __future__ import annotations

from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import pixel_maps

A = TypeVar("A", bound=NDArray[np.floating[Any]])

_XX, _XY, _YY = 0, 1, 3
"""Where the components of a plane's tensor stand among XX, XY, XZ, YY, YZ, ZZ."""


def in_space(vectors: A) -> A:
    """Return vectors with a Z that is 0 where they are known: (2, ...) or (3, ...) to (3, ...)."""
    if len(vectors) == 3:
        return vectors
    return cast(A, np.concatenate([vectors, 0.0 * vectors[:1]]))


def covariance_in_space(covariance: A) -> A:
    """Return packed covariances of vectors of space: (3, ...), XX, XY, YY, or (6, ...) to (6, ...)."""
    if len(covariance) == 6:
        return covariance
    packed = cast(A, np.repeat(0.0 * covariance[:1], 6, axis=0))
    packed[[_XX, _XY, _YY]] = covariance
    return packed


def trace(packed: NDArray[np.floating]) -> Floats:
    """Return the sums of the diagonals (...) of packed tensors: (6, ...), or (3, ...) of the plane."""
    total, *others = (packed[k] for k in ((0, 3, 5) if len(packed) == 6 else (0, 2)))
    total = total.astype(np.float64)
    for other in others:
        total += other
    return np.asarray(total)


def covariance_in_plane(packed: A) -> A:
    """Return what packed covariances of space (6, ...) say of X and Y: (3, ...), XX, XY, YY."""
    return cast(A, packed[[_XX, _XY, _YY]])


def pixels_as_plane(shape: tuple[int, ...], size: float = 1.0) -> Floats:
    """Return where the pixels of an image lie in its plane, (2, rows, columns).

    x points to the right and y up, from the middle of the first pixel, in the unit of a pixel's `size`.
    """
    maps = pixel_maps(*shape)
    maps[0] *= size
    maps[1] *= -size
    return maps
