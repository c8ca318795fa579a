"""Surfaces with their displacement and strain, of several views, brought into one frame and joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.fields.comparison import values_at
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import transform

Faces: TypeAlias = NDArray[np.int32]

_WITHIN = 1.5  # median edges: a point with nothing of the other view nearer is not in the overlap


@dataclass(frozen=True)
class StrainedSurface:
    """What a view measured at the vertices of its surface.

    Attributes
    ----------
    vertices, faces
        (n, 3) in mm and (m, 3).
    displacement
        (3, n) in mm, and its standard deviation `sigma` (n,).
    strain, strain_sigma
        (3, n): xx, yy, xy in the surface's plane, and their standard deviations.
    """

    vertices: Floats
    faces: Faces
    displacement: Floats
    sigma: Floats
    strain: Floats
    strain_sigma: Floats

    def edge(self) -> float:
        """Return the median length of the triangles' first edges, in mm; 0 without any."""
        a, b = (self.vertices[self.faces[:, k]] for k in (0, 1))
        return float(np.median(np.linalg.norm(a - b, axis=1))) if len(self.faces) else 0.0


def brought(surface: StrainedSurface, pose: Pose, axis: Floats, axis_there: Floats) -> StrainedSurface:
    """Return a surface in another frame, x_here = R x_there + T.

    Parameters
    ----------
    surface
        In its own frame.
    pose
        R and T.
    axis, axis_there
        (3,), unit vectors in the frame here and there, whose projections onto the surface are the x axis of
        strain: the requested one, and the one that it was stated along.
    """
    rotation = pose.matrix()
    vertices = transform(pose, surface.vertices)
    angle = _angle_between(vertex_normals(vertices, surface.faces), rotation @ axis_there, axis)
    strain, sigma = turned_in_plane(surface.strain, surface.strain_sigma, angle)
    return StrainedSurface(
        vertices, surface.faces, rotation @ surface.displacement, surface.sigma, strain, sigma
    )


def vertex_normals(vertices: Floats, faces: Faces) -> Floats:
    """Return unit normals (n, 3) at vertices, means over their triangles weighted by area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, faces[:, k], across)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / np.linalg.norm(total, axis=1, keepdims=True))


def _angle_between(normals: Floats, start: Floats, end: Floats) -> Floats:
    """Return the angle (n,) from one vector's projection to another's, about the normals, in rad."""
    first, second = (v - normals * (normals @ v)[:, None] for v in (start, end))
    across = np.einsum("ni,ni->n", np.cross(first, second), normals)
    return np.asarray(np.arctan2(across, np.einsum("ni,ni->n", first, second)))


def turned_in_plane(strain: Floats, sigma: Floats, angle: Floats) -> tuple[Floats, Floats]:
    """Return strain (3, n): xx, yy, xy, along axes turned by `angle` (n,) in rad, and its sigma.

    The components' errors count as independent of each other.
    """
    c, s = np.cos(angle), np.sin(angle)
    rows = ((c * c, s * s, 2.0 * c * s), (s * s, c * c, -2.0 * c * s), (-c * s, c * s, c * c - s * s))
    turned = [sum(f * part for f, part in zip(row, strain, strict=True)) for row in rows]
    variance = [sum((f * part) ** 2 for f, part in zip(row, sigma, strict=True)) for row in rows]
    return np.stack(turned), np.sqrt(np.stack(variance))


def differences(surfaces: Sequence[StrainedSurface]) -> tuple[list[Floats], dict[tuple[int, int], Floats]]:
    """Compare the displacements of surfaces in one frame where they overlap.

    Returns
    -------
    by_vertex
        Of each surface: (n,), the rms distance in mm between its displacement and those of later surfaces;
        NaN where none of them is.
    by_pair
        Of each two surfaces that overlap: (vertices of the first in the overlap, 2), the squared distance in
        mm^2 and what is stated of it.
    """
    by_vertex: list[Floats] = []
    by_pair: dict[tuple[int, int], Floats] = {}
    for a, first in enumerate(surfaces):
        squares, count = np.zeros(len(first.vertices)), np.zeros(len(first.vertices))
        for b in range(a + 1, len(surfaces)):
            second = surfaces[b]
            known = np.column_stack([second.displacement.T, second.sigma])
            there = values_at(second.vertices, known, first.vertices, _WITHIN * second.edge())
            square = np.sum((first.displacement.T - there[:, :3]) ** 2, axis=1)
            met = np.isfinite(square)
            squares[met] += square[met]
            count += met
            if met.any():
                stated = first.sigma[met] ** 2 + there[met, 3] ** 2
                by_pair[a, b] = np.column_stack([square[met], stated])
        with np.errstate(invalid="ignore", divide="ignore"):
            by_vertex.append(np.sqrt(squares / np.where(count > 0, count, np.nan)))
    return by_vertex, by_pair
