"""Exposures that keep every pixel in the camera's range, on surfaces whose brightness spans more than that.

From the brightness of white at every pixel either a set of exposures is chosen, whose frames are merged pixel
by pixel, or the projector's brightness is lowered where it would dazzle (thesis section 8.2). No fringe
pattern is brighter than white at any pixel, so what keeps white in range keeps the fringes in range.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats

HEADROOM = 0.9
"""Part of full scale that white is brought to: the rest is for noise and for what the pre-exposure missed."""


def exposure_set(
    brightness: Floats,
    full_scale: int,
    *,
    ratio: float = 4.0,
    ignored: float = 1e-3,
    longest: float = np.inf,
    most: int = 8,
) -> tuple[float, ...]:
    """Choose the fewest exposures that give every pixel one between `HEADROOM` / ratio and `HEADROOM`.

    Parameters
    ----------
    brightness
        Grey levels of white at exposure 1, any shape, of the pixels that matter: on the specimen and lit.
    full_scale
        Grey level at which the camera saturates.
    ratio
        By how much less light than it could have a pixel may get in its best exposure, above 1.
    ignored
        Part of the pixels, at the bright end and at the dark end, that need not be served.
    longest
        Exposure that is not exceeded, in units of that of `brightness`.
    most
        Number of exposures that is not exceeded; the darkest pixels go short first.

    Returns
    -------
    Exposures in units of that of `brightness`, shortest first.

    Notes
    -----
    A pixel's own best exposure is HEADROOM full_scale / brightness. Sorted, these are covered by intervals
    [e, ratio e] from the shortest on, which takes the least number.
    """
    usable = brightness[np.isfinite(brightness) & (brightness > 0.0)]
    if usable.size == 0:
        raise InvalidInput(
            "no pixel of the pre-exposure is in range, so no exposure can be chosen: shorten the pre-exposure"
        )
    best = np.sort(HEADROOM * full_scale / usable)
    skipped = int(ignored * best.size)
    best = best[skipped : best.size - skipped]
    chosen = [min(float(best[0]), longest)]
    while len(chosen) < most and chosen[-1] < longest:
        left = best[best > ratio * chosen[-1]]
        if left.size == 0:
            break
        chosen.append(min(float(left[0]), longest))
    return tuple(chosen)


def best_exposure(peaks: NDArray[Any], exposures: Sequence[float], full_scale: int) -> NDArray[np.uint8]:
    """Return the index of the longest exposure in which a pixel is not saturated; of the shortest if in none.

    Parameters
    ----------
    peaks
        (exposures, rows, columns), each pixel's highest grey level over the frames of an exposure.
    exposures
        Of each, in any unit.
    full_scale
        Grey level from which on a frame is saturated.
    """
    order = np.argsort(exposures)
    out = np.full(peaks.shape[1:], order[0], np.uint8)
    for i in order[1:]:
        out[peaks[i] < full_scale] = i
    return out


def merge_exposures(
    frames: NDArray[Any], exposures: Sequence[float], full_scale: int
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Merge the frames of several exposures: every pixel takes all its frames from its best one.

    Parameters
    ----------
    frames
        (exposures, frames, rows, columns), uint8 or uint16: the same patterns at each exposure.
    exposures
        Of each, in any unit.
    full_scale
        Grey level from which on a frame is saturated.

    Returns
    -------
    (frames, rows, columns), grey levels as they were recorded, so that the camera's noise model holds; and
    the index of the exposure, (rows, columns). A modulation found in them is to be divided by its exposure
    before its slope is taken for a texture's.

    Notes
    -----
    A pixel's phases go by B / sigma, which grows with the exposure as long as nothing is saturated: the
    longest such exposure e is the best, and weighs 1. The next shorter one, e / r, has 1/r of its information
    where shot noise rules and 1/r^2 where read noise does. With r = 4 using it too would lower the standard
    deviation by 11 % at most; it is left out for the sake of one noise model in every pixel.
    """
    index = best_exposure(frames.max(axis=1), exposures, full_scale)
    merged = frames[index.flat[0] if index.size else 0].copy()
    for i in range(len(frames)):
        np.copyto(merged, frames[i], where=index == i)
    return merged, index


def projector_dimming(
    brightness: Floats,
    projector_xy: Floats,
    columns: int,
    rows: int,
    full_scale: int,
    *,
    reach: int = 4,
    darkest: float = 0.02,
) -> Floats:
    """Return by which factor to lower the projector's brightness, pixel by pixel, so that none is dazzled.

    Parameters
    ----------
    brightness
        (...), grey level of white at full projector brightness, of camera pixels; infinite where unknown.
    projector_xy
        (..., 2), the projector pixel that lights each of them, NaN where unknown: from a measurement with an
        exposure that saturates nowhere.
    columns, rows
        Size of the projector's image.
    full_scale
        Grey level at which the camera saturates.
    reach
        Projector pixels by which light spreads, and over which the factor is made smooth.
    darkest
        Least factor.

    Returns
    -------
    (rows, columns), `darkest` .. 1; the fringe patterns are multiplied by it.

    Notes
    -----
    Each projector pixel is allowed HEADROOM full_scale over the brightest camera pixel that it lights. The
    minimum over a window and then the mean over the same window is smooth and nowhere above what is allowed.
    """
    finite = np.isfinite(projector_xy).all(axis=-1)
    place = np.rint(projector_xy[finite]).astype(np.int64)
    inside = ((place >= 0) & (place < [columns, rows])).all(axis=-1)
    place, level = place[inside], brightness[finite][inside]
    with np.errstate(divide="ignore"):
        factor = np.clip(HEADROOM * full_scale / level, darkest, 1.0)
    allowed = np.ones((rows, columns))
    np.minimum.at(allowed, (place[:, 1], place[:, 0]), factor)
    window = 2 * reach + 1
    lowest = ndimage.minimum_filter(allowed, window, mode="nearest")
    return np.asarray(ndimage.uniform_filter(lowest, window, mode="nearest"))
