"""Triangles between neighbouring pixels of measured surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput

Indices = NDArray[np.int32]


def triangulate_image(labels: NDArray[np.int32], step: int = 1) -> tuple[Indices, Indices]:
    """Join every `step`-th pixel of a region with its neighbours.

    A square of four pixels of one region becomes two triangles, one that lacks a corner one triangle;
    nothing is joined across regions or holes.

    Parameters
    ----------
    labels
        (rows, columns), region of each pixel; 0 and below is no surface.
    step
        Distance of the vertices in pixels, at least 1.

    Returns
    -------
    vertices
        (vertices, 2): row and column of the pixel of each vertex, in the order of the image; pixels that no
        triangle uses are left out.
    faces
        (faces, 3): vertex indices, counter-clockwise seen from the camera.

    Notes
    -----
    Rows point down: a corner turns counter-clockwise to the eye when it goes from the top left down, then
    right. The diagonal runs from the bottom left to the top right.

    Raises `InvalidInput` for a step below 1.
    """
    if step < 1:
        raise InvalidInput(f"the step of a mesh is at least 1 pixel, not {step}")
    grid = labels[::step, ::step]
    number = np.arange(grid.size, dtype=np.int32).reshape(grid.shape)
    before, after = slice(None, -1), slice(1, None)
    a, b = number[before, before], number[before, after]  # a b
    c, d = number[after, before], number[after, after]  # c d
    la, lb, lc, ld = (grid.reshape(-1)[n] for n in (a, b, c, d))
    lower_left = (la == lc) & (la == lb) & (la > 0)
    upper_right = (lb == lc) & (lb == ld) & (lb > 0)
    upper_left = (la == lb) & (la == ld) & (la > 0) & (lc != la)
    lower_right = (la == lc) & (la == ld) & (la > 0) & (lb != la)
    triangles = (
        (lower_left, (a, c, b)),
        (upper_right, (b, c, d)),
        (upper_left, (a, d, b)),
        (lower_right, (a, c, d)),
    )
    faces = np.concatenate([np.stack([n[where] for n in abc], axis=-1) for where, abc in triangles])
    used, faces_used = np.unique(faces, return_inverse=True)
    vertices = np.stack(np.unravel_index(used, grid.shape), axis=-1) * step
    return vertices.astype(np.int32), faces_used.reshape(faces.shape).astype(np.int32)
