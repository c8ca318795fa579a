"""Where a camera sees given phases: the inverse of its phase maps, at a part of a pixel.

Two directions of fringes give every point of a surface a pair of phases that no other point has. Where two
cameras see one pair they see one point, whatever the projector is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree
from scipy.special import chdtri

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.images.masks import at_edge

_SMALLEST_GAP = 4  # px; fewer that fail are no edge but noise
_NEAR_PX = (
    4.0  # from the nearest pixel that is known to phases that are looked for, in the metric of the tree
)
_MOVES = 4  # from pixel to pixel, at most
_NEWTON = 3  # steps on a parabola that is nearly a plane: each squares what is left
_WITHIN_PX = 0.6  # of the middle of a parabola: half a pixel, and some more so that none is passed to and fro
_CHANCE = 1e-6  # at which noise alone makes nine pixels no parabola, or a step
_STEP_SIGMAS = 5.0

_FLAT, _TILT, _BEND = (np.array(one) / np.linalg.norm(one) for one in ((1, 1, 1), (-1, 0, 1), (1, -2, 1)))
"""Orthonormal polynomials over three pixels."""
_AROUND = np.array([(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)])
_POWERS = np.stack(
    [
        np.ones(9),
        _AROUND[:, 1],
        _AROUND[:, 0],
        _AROUND[:, 1] ** 2,
        _AROUND[:, 1] * _AROUND[:, 0],
        _AROUND[:, 0] ** 2,
    ]
)
_FIT = np.linalg.pinv(_POWERS.T.astype(np.float64))
"""(6, 9): from nine pixels to the parabola 1, x, y, xx, xy, yy about the middle one."""


@dataclass(frozen=True)
class Places:
    """Where n pairs of phases are seen; NaN where they are not, or nobody can tell.

    Attributes
    ----------
    place
        (2, n), x and y in px.
    by_omega
        (2, directions, n) in px/rad: how the place moves with the phases that are looked for.
    """

    place: Floats
    by_omega: Floats


@dataclass(frozen=True)
class PhaseMap:
    """The phase gradients that a camera sees, to be looked up.

    Attributes
    ----------
    omega, sigma
        (directions, rows, columns) in rad: at least two directions, and how far they may be off a parabola.
    usable
        (rows, columns): whose phases can be trusted.
    threads
        How many threads to use; the result does not depend on it.
    """

    omega: Floats
    sigma: Singles
    usable: Mask
    threads: int = 1

    @cached_property
    def middles(self) -> Mask:
        """The pixels (rows, columns) about which nine are a piece of one surface: see `on_parabolas`."""
        inside = self.usable & ~at_edge(self.usable, _SMALLEST_GAP)
        return on_parabolas(np.where(inside, self.omega, 0.0), self._mean_variance, inside)

    @cached_property
    def _mean_variance(self) -> Floats:
        """The mean variance of the nine pixels about each, (directions, rows, columns) in rad^2."""
        square = np.square(np.where(self.usable, self.sigma, 0.0), dtype=np.float64)
        return np.stack([ndimage.uniform_filter(one, 3, mode="nearest") for one in square])

    @cached_property
    def _scale(self) -> Floats:
        """How much phases change by a pixel, (directions,) in rad."""
        slopes = [
            np.hypot(_filtered(one, _FLAT, _TILT), _filtered(one, _TILT, _FLAT))[self.middles] / np.sqrt(6.0)
            for one in np.where(self.usable, self.omega, 0.0)
        ]
        return np.array([max(float(np.median(slope)), np.finfo(float).tiny) for slope in slopes])

    @cached_property
    def _tree(self) -> tuple[KDTree, NDArray[np.intp]]:
        """The phases of all middles, in px, and the places of these in the image, flat."""
        flat = np.flatnonzero(self.middles)
        phases = self.omega.reshape(len(self.omega), -1)[:, flat] / self._scale[:, None]
        return KDTree(phases.T), flat

    def _nearest(self, omega: Floats) -> NDArray[np.intp]:
        """Return the middles whose phases are the nearest to phases (directions, n), flat; -1 for none."""
        near = np.full(omega.shape[1], -1, dtype=np.intp)
        known = np.flatnonzero(np.isfinite(omega).all(axis=0))
        if not self.middles.any() or not len(known):
            return near
        tree, flat = self._tree
        at = (omega[:, known] / self._scale[:, None]).T
        distance, which = tree.query(at, distance_upper_bound=_NEAR_PX, workers=self.threads)
        found = np.isfinite(distance)
        near[known[found]] = flat[which[found]]
        return near

    def find(self, omega: Floats, sigma: Singles) -> Places:
        """Return where phases (directions, n) of standard deviations are seen, both in rad.

        By Newton's method on the parabola about the nearest pixel, and from pixel to pixel.
        """
        count = omega.shape[1]
        place, by_omega = np.full((2, count), np.nan), np.full((2, len(omega), count), np.nan)
        near = self._nearest(omega)
        left = np.flatnonzero(near >= 0)
        rows, columns = np.divmod(near[left], self.usable.shape[1])
        for _ in range(_MOVES):
            if not len(left):
                break
            off, slopes = self._on_parabola(omega[:, left], sigma[:, left], rows, columns)
            with np.errstate(invalid="ignore"):
                here = (np.abs(off) <= _WITHIN_PX).all(axis=0)
            done = left[here]
            place[:, done] = np.stack([columns[here], rows[here]]) + off[:, here]
            by_omega[..., done] = slopes[..., here]
            left, step = left[~here], np.clip(np.rint(off[:, ~here]), -2.0, 2.0)
            known = np.isfinite(step).all(axis=0)
            left, rows, columns, step = left[known], rows[~here][known], columns[~here][known], step[:, known]
            columns, rows = columns + step[0].astype(np.intp), rows + step[1].astype(np.intp)
            inside = (rows >= 0) & (columns >= 0)
            inside &= (rows < self.usable.shape[0]) & (columns < self.usable.shape[1])
            inside[inside] = self.middles[rows[inside], columns[inside]]
            left, rows, columns = left[inside], rows[inside], columns[inside]
        return Places(place, by_omega)

    def _on_parabola(
        self, omega: Floats, sigma: Singles, rows: NDArray[np.intp], columns: NDArray[np.intp]
    ) -> tuple[Floats, Floats]:
        """Return how far from pixels phases are seen, (2, n) in px, and how that moves with them."""
        nine = self.omega[:, rows + _AROUND[:, :1], columns + _AROUND[:, 1:]]
        parabola = np.einsum("ij,kjn->kin", _FIT, nine)
        weight = 1.0 / np.square(sigma, dtype=np.float64)
        off = np.zeros((2, len(rows)))
        slopes = np.zeros((2, *omega.shape))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(_NEWTON):
                x, y = off
                one, a, b, aa, ab, bb = np.moveaxis(parabola, 1, 0)
                value = one + a * x + b * y + aa * x * x + ab * x * y + bb * y * y
                by_x, by_y = a + 2.0 * aa * x + ab * y, b + ab * x + 2.0 * bb * y
                xx, xy, yy = (np.sum(weight * p, axis=0) for p in (by_x * by_x, by_x * by_y, by_y * by_y))
                area = xx * yy - xy * xy
                slopes = np.stack([weight * (yy * by_x - xy * by_y), weight * (xx * by_y - xy * by_x)]) / area
                off = off + np.einsum("ikn,kn->in", slopes, omega - value)
        return off, slopes


def on_parabolas(omega: Floats, variance: Floats, known: Mask) -> Mask:
    """Return about which pixels (rows, columns) nine follow a parabola, as far as noise tells.

    Parameters
    ----------
    omega, variance
        (directions, rows, columns): phases in rad, and the mean of their variances over the nine pixels.
    known
        (rows, columns): whose phases there are.

    Notes
    -----
    Of the nine products of orthonormal polynomials over three pixels three are none of a parabola; their
    squares follow a chi-square law. A step along rows or columns is a parabola for three pixels, but not for
    four: there the bends of neighbours differ, whose difference has 20 / 6 of their variance.
    """
    whole = ndimage.binary_erosion(known, np.ones((3, 3), dtype=bool))
    others = ((_TILT, _BEND), (_BEND, _TILT), (_BEND, _BEND))
    with np.errstate(divide="ignore", invalid="ignore"):
        square = sum(
            _filtered(one, down, right) ** 2 / v
            for one, v in zip(omega, variance, strict=True)
            for down, right in others
        )
        good = whole & (square < float(chdtri(3 * len(omega), _CHANCE)))
        for axis, (down, right) in ((1, (_FLAT, _BEND)), (0, (_BEND, _FLAT))):
            bends = np.array([_filtered(one, down, right) for one in omega]) / np.sqrt(variance)
            good &= _bends_alike(bends, whole, axis)
    return np.asarray(good)


def _filtered(image: Floats, down: Floats, right: Floats) -> Floats:
    along = ndimage.correlate1d(image, right, axis=1, mode="nearest")
    return np.asarray(ndimage.correlate1d(along, down, axis=0, mode="nearest"))


def _bends_alike(bends: Floats, known: Mask, axis: int) -> Mask:
    """Return where bends (directions, rows, columns) in deviations are those of a neighbour along an axis.

    Of each neighbour that is `known`, and of one at least.
    """
    limit = _STEP_SIGMAS * np.sqrt(20.0 / 6.0)
    alike, some = known.copy(), np.zeros_like(known)
    for step in (-1, 1):
        there = np.roll(known, step, axis)
        edge: list[slice | int] = [slice(None), slice(None)]
        edge[axis] = 0 if step > 0 else -1
        there[tuple(edge)] = False
        off = np.abs(bends - np.roll(bends, step, axis + 1)).max(axis=0)
        alike &= ~there | (off < limit)
        some |= there
    return np.asarray(alike & some)


def carried(fields: Floats | Singles, place: Floats) -> Floats:
    """Return fields (k, rows, columns) at places (2, n) between pixels, (k, n); NaN where there is none.

    Linearly: of what says how much something else may be off.
    """
    known = np.isfinite(place).all(axis=0)
    found = np.full((len(fields), place.shape[1]), np.nan)
    for one, values in zip(found, fields, strict=True):
        one[known] = ndimage.map_coordinates(values, place[::-1, known], order=1, mode="nearest")
    return found
