"""The texture of a surface as a camera sees it, and what it does to the phases there.

By how much the light of a pixel is off towards where it is brighter, and how much of that its neighbours
cannot tell: see `metrology.phase.texture_error`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks, inner, uncounted_kernel
from sms_jobs.metrology.images.masks import alone, at_edge

Floating = NDArray[np.floating]

_FILLED_FROM = (5, 5)  # px about a pixel that is not lit
_RINGING_PX = (9, 9)  # about one: what a cubic spline makes of a bend falls to 0.27 a pixel, 0.005 in four
_OUTERMOST = 5.0  # in focus s^2 is some five times rough_px, and across the border nothing is corrected
_SMALLEST_GAP = 4  # px; fewer that fail are no edge but noise
_REACH_PX = 2  # how far off the neighbours are that tell how phases change

Shift: TypeAlias = tuple[Floats, Singles]
"""What texture does to phases: see `texture_shift`."""


def log_gradient(brightness: Floating, lit: Mask, relative: Floats) -> Floats:
    """Return the gradient of ln(brightness) along columns and rows, (2, rows, columns) in 1/px.

    Of the logarithm's spline: that of the brightness itself rings beside a bright place by more than a dark
    one has. Near what is not `lit` (rows, columns), since darkness has no logarithm, it is `relative`, of
    `relative_gradient`, all the same. The outermost pixels of the image, where a spline would have to know
    what lies beyond, have no gradient across the border.
    """
    import cv2

    image = np.asarray(brightness, dtype=np.float64)
    lit = lit & (image > 0.0)
    rim = at_edge(lit, _SMALLEST_GAP)
    gradient = _spline_gradient(_logarithm(image, lit & ~rim))
    near = cv2.dilate(rim.astype(np.uint8), np.ones(_RINGING_PX, np.uint8)).astype(bool)
    gradient[:, near] = relative[:, near]
    return gradient


def relative_gradient(brightness: Floating) -> Floats:
    """Return the gradient of the brightness over the brightness, (2, rows, columns) in 1/px; 0 in darkness.

    As `log_gradient` returns it, but of the spline of the brightness, which needs no logarithm: of smooth
    bodies before darkness, as spheres are.
    """
    image = np.asarray(brightness, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        gradient = _spline_gradient(image) / image
    return np.nan_to_num(gradient, copy=False, nan=0.0, posinf=0.0, neginf=0.0)


def _logarithm(image: Floats, known: Mask) -> Floats:
    """Return ln(image); where it is not known, the mean of what is near, so that little rings."""
    import cv2

    if not known.any():
        return np.zeros_like(image)
    logarithm = np.log(np.where(known, image, 1.0))
    share, total = (
        cv2.blur(values, _FILLED_FROM, borderType=cv2.BORDER_REPLICATE)
        for values in (known.astype(np.float64), logarithm)
    )
    near = share > 1e-3  # less than one of 25 is none
    filled = np.where(near, total / np.where(near, share, 1.0), logarithm[known].mean())
    return np.where(known, logarithm, filled)


def _spline_gradient(image: Floats) -> Floats:
    """Return the derivatives of the interpolating cubic spline along columns and rows, (2, rows, columns).

    Speckles of a few pixels have too much fine detail for central differences, which would leave twice the
    error.
    """
    gradient = np.empty((2, *image.shape))
    for component, axis in enumerate((1, 0)):
        spline = ndimage.spline_filter1d(image, 3, axis=axis, mode="mirror")
        gradient[component] = ndimage.correlate1d(spline, [-0.5, 0.0, 0.5], axis=axis, mode="mirror")
    return gradient


def roughness(brightness: Floating) -> Floats:
    """Return how much the brightness changes within three pixels along columns and rows, (2, rows, columns).

    The length of its central first and its second difference, in units of the pixel's brightness: an edge in
    the middle of a pixel is all slope, one at its side half bend. The outermost pixels count more: they have
    no gradient.
    """
    image = np.asarray(brightness, dtype=np.float64)
    rough = np.empty((2, *image.shape))
    for component, axis in enumerate((1, 0)):
        slope, bend = (
            ndimage.correlate1d(image, weights, axis=axis, mode="nearest")
            for weights in ([-0.5, 0.0, 0.5], [1.0, -2.0, 1.0])
        )
        rough[component] = np.hypot(slope, bend)
        np.moveaxis(rough[component], axis, 0)[[0, -1]] *= _OUTERMOST
    with np.errstate(divide="ignore", invalid="ignore"):
        rough /= image
    return np.nan_to_num(rough, copy=False, nan=0.0, posinf=0.0, neginf=0.0)


@inner
@uncounted_kernel
def _difference(before: float, here: float, after: float) -> float:
    """Return the slope at a pixel from valid neighbours (NaN if not); the gentler side where they disagree.

    Across an edge of the surface one side's slope is the edge's.
    """
    back, forth = here - before, after - here
    if np.isnan(back):
        return 0.0 if np.isnan(forth) else forth
    if np.isnan(forth):
        return back
    if abs(forth - back) <= 0.5 * max(abs(forth), abs(back)):
        return 0.5 * (forth + back)
    return forth if abs(forth) < abs(back) else back


@inner
@uncounted_kernel
def _is_usable(valid: Mask, row: int, column: int) -> bool:
    """Say whether a pixel is in the image and valid."""
    inside = row >= 0 and column >= 0 and row < valid.shape[0] and column < valid.shape[1]
    return inside and valid[row, column]


@uncounted_kernel
def _shift_rows(
    omega: Floats,
    valid: Mask,
    gradient: Floats,
    rough: Floats,
    start: int,
    stop: int,
    shift: Floats,
    spread: Singles,
) -> None:
    for row in range(start, stop):
        for column in range(valid.shape[1]):
            if not valid[row, column]:
                continue
            for axis in range(2):
                has_before, has_after, reach = False, False, 0
                while reach < _REACH_PX and not (has_before or has_after):
                    reach += 1
                    down, right = reach * axis, reach * (1 - axis)
                    r0, c0, r1, c1 = row - down, column - right, row + down, column + right
                    has_before, has_after = _is_usable(valid, r0, c0), _is_usable(valid, r1, c1)
                for k in range(omega.shape[0]):
                    before = omega[k, r0, c0] if has_before else np.nan
                    after = omega[k, r1, c1] if has_after else np.nan
                    slope = _difference(before, omega[k, row, column], after) / reach
                    shift[k, row, column] += slope * gradient[axis, row, column]
                    unseen = slope * rough[axis, row, column]
                    spread[k, row, column] += unseen * unseen
            for k in range(omega.shape[0]):
                spread[k, row, column] = np.sqrt(spread[k, row, column])


def texture_shift(omega: Floats, valid: Mask, gradient: Floats, rough: Floats, threads: int = 1) -> Shift:
    """Return by how much the texture moves omega: per unit of s^2, and per px that light is off unseen.

    Parameters
    ----------
    omega
        (orientations, rows, columns) in rad.
    valid
        (rows, columns): whose omega can be used.
    gradient
        (2, rows, columns) in 1/px: `log_gradient` of the modulation.
    rough
        (2, rows, columns): `roughness` of the modulation.

    Returns
    -------
    grad(omega) . grad(ln B), (orientations, rows, columns) in rad/px^2; and the length of the vector with the
    components d(omega)/dx rough_x and d(omega)/dy rough_y, likewise in rad/px. 0 where not valid.
    """
    shift, spread = np.zeros_like(omega), np.zeros(omega.shape, np.float32)

    def work(start: int, stop: int) -> None:
        _shift_rows(omega, valid, gradient, rough, start, stop, shift, spread)

    in_row_blocks(work, len(valid), threads)
    return shift, spread


@dataclass(frozen=True)
class SeenTexture:
    """The texture in a camera's image.

    Attributes
    ----------
    gradient, relative
        (2, rows, columns) in 1/px, of `log_gradient` and `relative_gradient`.
    rough
        (2, rows, columns) of `roughness`.
    usable
        (rows, columns): whose omega can be used.
    threads
        How many threads to use; the result does not depend on it.
    """

    gradient: Floats
    relative: Floats
    rough: Floats
    usable: Mask
    threads: int

    @classmethod
    def of(cls, modulation: Singles, usable: Mask, lit: Mask, threads: int) -> SeenTexture:
        """Return that of the modulation (directions, rows, columns), which is known where it is `lit`."""
        brightness = modulation.mean(axis=0)
        relative = relative_gradient(brightness)
        gradient = log_gradient(brightness, lit, relative)
        return cls(gradient, relative, roughness(brightness), usable, threads)

    def shift(self, omega: Floats) -> Shift:
        """Return what `texture_shift` does, of phases that the camera sees."""
        return texture_shift(omega, self.usable, self.gradient, self.rough, self.threads)

    def beside(self, variance: float, most_px: float) -> tuple[Mask, Mask]:
        """Return whose light comes from farther off than it may, and of which `relative` alone says so.

        Of pixels so far from all others that nothing tells how phases change there, that is not known.
        """
        far, doubtful = (
            self.usable & (variance * np.hypot(slope[0], slope[1]) > most_px)
            for slope in (self.gradient, self.relative)
        )
        return far | alone(self.usable, _REACH_PX), doubtful
