"""Gray code of stripes beside fringes: which stripe of the projector a pixel sees.

Pattern b of n, the coarsest first, is bright where bit b of the stripe's Gray code is set; neighbouring
stripes differ in one pattern only, so that a pixel on their border is read as one of the two. With at least
two stripes a fringe such a pixel is still closer than half a fringe to the truth.
"""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.temporal_unwrapping import CoarseGradient

UNREAD = -1
"""Number of a stripe that cannot be read."""

LARGEST_BITS = 16


def read_stripes(
    frames: NDArray[Any], threshold: NDArray[Any], doubt: float | NDArray[Any]
) -> NDArray[np.int32]:
    """Return the number of the stripe that every pixel sees.

    Parameters
    ----------
    frames
        (bits, rows, columns) in grey levels, the coarsest first.
    threshold
        (rows, columns), or (bits, rows, columns) of the inverse patterns: brighter is a set bit.
    doubt
        Distance from the threshold in grey levels below which a bit may have been misread, a number or an
        array like the threshold. One such bit is on
        a border of two stripes; with more of them the stripe cannot be read.

    Returns
    -------
    (rows, columns), `UNREAD` where it cannot be read. Raises `InvalidInput` for more than 16 patterns.
    """
    bits = len(frames)
    if not 1 <= bits <= LARGEST_BITS:
        raise InvalidInput(f"a Gray code has 1 to {LARGEST_BITS} patterns, not {bits}")
    limits, doubts = np.broadcast_to(threshold, frames.shape), np.broadcast_to(doubt, frames.shape)
    stripe = np.zeros(frames.shape[1:], np.int32)
    set_above = np.zeros(frames.shape[1:], np.bool_)
    doubtful = np.zeros(frames.shape[1:], np.uint8)
    for frame, limit, unsure in zip(frames, limits, doubts, strict=True):
        above = frame.astype(np.float32) - limit
        # A Gray code is read from the coarsest pattern on: each set bit turns those that follow.
        set_above ^= above > 0.0
        stripe = (stripe << 1) | set_above
        doubtful += np.abs(above) < unsure
    stripe[doubtful > 1] = UNREAD
    return stripe


def gradient_of_stripes(stripe: NDArray[np.int32], stripes: float) -> CoarseGradient:
    """Return the phase gradient at the middle of stripes of which `stripes` go across the projector.

    omega = 2 pi ((stripe + 1/2) / stripes - 1/2), and the truth is within pi / stripes of it.
    """
    if not stripes >= 2.0:
        raise InvalidInput(f"a Gray code has at least 2 stripes across the projector, not {stripes:g}")
    middle = 2.0 * pi * ((stripe + 0.5) / stripes - 0.5)
    return CoarseGradient(np.where(stripe == UNREAD, np.nan, middle), pi / stripes)
