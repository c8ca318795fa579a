"""What errors that all points have in common, as those of a calibration, make of strain.

Errors are given as columns of a factor, each the displacement of every point by one independent cause of unit
variance; strain is taken to first order in them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Mask

Factor: TypeAlias = Callable[[Floats], Floats]
"""The factor (n, 3, r) of points (n, 3)."""

_SIDE = 9
"""Samples along a side of the square of pixels that tell how a surface lies about a point."""
_LEAST = 12


@dataclass(frozen=True)
class Tangents:
    """How a surface lies at n points, and what has become of it.

    Attributes
    ----------
    place
        (n, 3), at the reference state.
    moved
        (n, 3), where it has come to.
    axes
        (n, 2, 3), unit vectors e_x and e_y of the tangent plane.
    stretched
        (n, 2, 3), what they have become: with the slopes d,x and d,y of the displacement, e + d.
    """

    place: Floats
    moved: Floats
    axes: Floats
    stretched: Floats

    def only(self, some: Mask) -> Tangents:
        """Return some of the points (n,)."""
        return Tangents(self.place[some], self.moved[some], self.axes[some], self.stretched[some])


def tangents(
    xyz: Floats,
    displacement: Floats,
    labels: NDArray[np.int32],
    pixels: tuple[Ints, Ints],
    *,
    radius: float,
    reach_px: int,
    x_axis: tuple[float, float, float],
) -> Tangents:
    """Return how the surface lies about some pixels, NaN where too few of their region are near.

    Parameters
    ----------
    xyz, displacement
        (3, rows, columns), in one unit of length; NaN where there is none.
    labels
        (rows, columns); pixels of one region lie on one surface.
    pixels
        Rows and columns (n,).
    radius, reach_px
        How far pixels count, in that unit and in the image.
    x_axis
        Unit vector whose projection onto the surface is e_x.

    Notes
    -----
    The plane of the points' principal axes, and least-squares slopes of the displacement, of at most 81
    pixels. Which side is outside is left open, and so is the sign of e_y.
    """
    rows, columns = pixels
    offsets = np.unique(np.round(np.linspace(-reach_px, reach_px, _SIDE)).astype(np.int64))
    dy, dx = (each.ravel() for each in np.meshgrid(offsets, offsets, indexing="ij"))
    y, x = rows[:, None] + dy, columns[:, None] + dx
    height, width = labels.shape
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    y, x = np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)
    place, moved = (np.moveaxis(each[:, rows, columns], 0, -1) for each in (xyz, displacement))
    points, shifts = (np.moveaxis(each[:, y, x], 0, -1) for each in (xyz, displacement))
    away = points - place[:, None]
    with np.errstate(invalid="ignore"):
        near = np.sum(away**2, axis=2) <= radius**2
    used = inside & near & (labels[y, x] == labels[rows, columns][:, None]) & np.isfinite(shifts).all(axis=2)
    weight = used[:, :, None].astype(np.float64)
    count = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    away, shifts = (np.where(used[:, :, None], each, 0.0) for each in (away, shifts))
    away, shifts = (weight * (each - each.sum(axis=1, keepdims=True) / count) for each in (away, shifts))
    scatter = away.transpose(0, 2, 1) @ away
    sizes, vectors = np.linalg.eigh(scatter)
    normal = vectors[:, :, 0]
    axis = np.asarray(x_axis, dtype=np.float64)
    along = axis - (normal @ axis)[:, None] * normal
    length = np.linalg.norm(along, axis=1, keepdims=True)
    flat = (sizes[:, 1] > 1e-2 * sizes[:, 2]) & (length[:, 0] > 1e-3) & (used.sum(axis=1) >= _LEAST)
    with np.errstate(invalid="ignore", divide="ignore"):
        axes = np.stack([along / length, np.cross(normal, along / length)], axis=1)
    axes[~flat] = np.nan
    place, moved = (np.where(flat[:, None], each, np.nan) for each in (place, place + moved))
    spread = axes @ scatter @ axes.transpose(0, 2, 1)
    spread[~flat] = np.eye(2)
    slopes = np.linalg.solve(spread, axes @ (away.transpose(0, 2, 1) @ shifts))
    return Tangents(place, moved, axes, axes + slopes)


def directional(factor: Factor, at: Floats, along: Floats, step: float) -> Floats:
    """Return the change of a factor along vectors (n, 2, 3) at points (n, 3), (n, 2, 3, r)."""
    ends = [factor((at[:, None] + sign * step * along).reshape(-1, 3)) for sign in (1.0, -1.0)]
    change = (ends[0] - ends[1]) / (2.0 * step)
    return np.asarray(change.reshape(*along.shape, -1))


def mean_slopes(factors: Floats, points: Floats, axes: Floats) -> Floats:
    """Return the least-squares slopes (2, 3, r) along axes (2, 3) of factors (n, 3, r) of points (n, 3)."""
    away = (points - points.mean(axis=0)) @ axes.T
    return np.asarray(np.tensordot(np.linalg.pinv(away), factors, axes=1))


def strain_factor(
    axes: Floats,
    stretched: Floats,
    before: Floats,
    after: Floats,
    x_axis: tuple[float, float, float],
    *,
    green_lagrange: bool = True,
) -> Floats:
    """Return the factor of the strains xx, yy and xy, (n, 3, r); the sign of xy is that of the axes given.

    Parameters
    ----------
    axes, stretched
        (n, 2, 3): e_a of the tangent plane, and f_a = e_a + d,a, what they have become.
    before, after
        (n, 2, 3, r): change G_a of the reference's factor along e_a, g_a of the deformed state's along f_a.
    x_axis
        Unit vector whose projection onto the surface is e_x: it is fixed, and the surface is measured turned.
    green_lagrange
        True for Green-Lagrange strain, False for small strain.

    Notes
    -----
    What lies along e_a is measured along e_a + G_a, and has become f_a + g_a. The measured axes are
    e_a + de_a: they follow the surface's normal n, and turn about it by
    s = (x n) (n G_y) / |x - (x n) n|, since the axis x stays. With H_ba = e_b G_a + de_b e_a,
    Green-Lagrange strain changes by (f_a g_b + g_a f_b - (H^T C + C H)_ab) / 2 where C_ab = f_a f_b, and
    small strain by the symmetric part of e_a (g_b - G_b) - e_a d,c H_cb + de_a d,b. Error propagation, to
    first order: a rigid motion of both states changes Green-Lagrange strain by no more than the turn of its
    axes.
    """
    axis = np.asarray(x_axis, dtype=np.float64)
    normal = np.cross(axes[:, 0], axes[:, 1])
    tilt = np.einsum("ni,naik->nak", normal, before)
    cosine = normal @ axis
    turn = (cosine / np.linalg.norm(axis - cosine[:, None] * normal, axis=1))[:, None] * tilt[:, 1]
    h = np.einsum("nbi,naik->nbak", axes, before)
    h[:, 0, 1] += turn
    h[:, 1, 0] -= turn
    if green_lagrange:
        metric = stretched @ stretched.transpose(0, 2, 1)
        change = np.einsum("nai,nbik->nabk", stretched, after) - np.einsum("nac,ncbk->nabk", metric, h)
    else:
        slopes = stretched - axes
        turned = normal[:, None, :, None] * tilt[:, :, None]
        turned += np.stack([axes[:, 1], -axes[:, 0]], axis=1)[..., None] * turn[:, None, None]
        change = np.einsum("nai,nbik->nabk", axes, after - before)
        change -= np.einsum("nac,ncbk->nabk", axes @ slopes.transpose(0, 2, 1), h)
        change += np.einsum("naik,nbi->nabk", turned, slopes)
    symmetric = 0.5 * (change + change.swapaxes(1, 2))
    return np.stack([symmetric[:, 0, 0], symmetric[:, 1, 1], symmetric[:, 0, 1]], axis=1)
