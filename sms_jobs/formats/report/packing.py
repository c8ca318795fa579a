"""Fields as text inside a page: sampled, rounded to their accuracy, compressed.

Values become whole numbers of a step, from 1 to 65534; 0 stands for none. The step is the finest that the
range allows, or a twelfth of the median standard deviation where that is coarser: rounding then adds less
than a thousandth to the variance, (1/12)^2 / 12. Of standard deviations the logarithm is kept in 8 bits, in
steps of at least 0.08: nobody knows them to 4 %.

What is kept of a number is how far it is from what its neighbours let expect: the median of the one to the
left, the one above, and their sum less the one between (Weinberger, Seroussi and Sapiro, The LOCO-I lossless
image compression algorithm, IEEE Trans. Image Process. 9, 2000). Small differences of either sign are small
numbers, 0, -1, 1, -2 ... becoming 0, 1, 2, 3 ...; the high bytes lie before the low ones, and all is
compressed by zlib and written in base64, which every browser unpacks by itself.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np
from numpy.typing import NDArray

LARGEST = 65534
SIGMA_LARGEST = 254
FINEST_SIGMA = 0.08
PART_OF_SIGMA = 12.0
_LEVEL = 6


@dataclass(frozen=True)
class Packed:
    """Values as text: value = low + (n - 1) step, with n = 0 for none.

    Attributes
    ----------
    text
        base64 of zlib of two bytes a value.
    """

    low: float
    step: float
    text: str


@dataclass(frozen=True)
class PackedSigma:
    """Standard deviations as text: sigma = low exp((n - 1) step), with n = 0 for none, one byte a value."""

    low: float
    step: float
    text: str


def pack(values: NDArray[np.float32], sigma: NDArray[np.float32] | None = None, grain: float = 0.0) -> Packed:
    """Return values (rows, columns) packed, in steps of at least `grain`.

    Whole numbers without standard deviations keep their value.
    """
    known = np.isfinite(values)
    exact = np.where(known, values, 0.0).astype(np.float64)
    low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
    whole = sigma is None and high - low <= LARGEST - 1 and bool(np.all(exact == np.round(exact)))
    step = 1.0 if whole else max(grain, (high - low) / (LARGEST - 1)) or 1.0
    if sigma is not None and np.any(np.isfinite(sigma)):
        step = max(step, float(np.nanmedian(np.where(np.isfinite(sigma), sigma, np.nan))) / PART_OF_SIGMA)
    number = np.where(known, np.round((exact - low) / step) + 1.0, 0.0).astype(np.uint16)
    return Packed(low, step, _text(_planes(_differences(number))))


def pack_sigma(sigma: NDArray[np.float32]) -> PackedSigma:
    """Return standard deviations (rows, columns) packed, those that are not above 0 as none."""
    known = np.isfinite(sigma) & (sigma > 0.0)
    low, high = (float(sigma[known].min()), float(sigma[known].max())) if known.any() else (1.0, 1.0)
    step = max(log(high / low) / (SIGMA_LARGEST - 1), FINEST_SIGMA)
    number = np.zeros(sigma.shape, np.uint8)
    if known.any():
        number[known] = 1 + np.round(np.log(sigma[known] / low) / step)
    return PackedSigma(low, step, _text(_differences(number)))


def _differences(number: NDArray[Any]) -> NDArray[Any]:
    """Return how far each number is from what its neighbours let expect, modulo its bits; small is near."""
    left, above, between = (np.zeros_like(number) for _ in range(3))
    left[:, 1:], above[1:], between[1:, 1:] = number[:, :-1], number[:-1], number[:-1, :-1]
    # The first row knows what is to the left alone, the first column what is above.
    above[0], left[1:, 0], between[1:, 0] = left[0], above[1:, 0], above[1:, 0]
    between[0] = left[0]
    low, high = np.minimum(left, above), np.maximum(left, above)
    expected = np.clip(left.astype(np.int32) + above - between, low, high)
    bits = 8 * number.itemsize
    signed = (number - expected).astype(f"i{number.itemsize}")
    found: NDArray[Any] = ((signed << 1) ^ (signed >> (bits - 1))).astype(number.dtype)
    return found


def _planes(number: NDArray[np.uint16]) -> NDArray[np.uint8]:
    return np.stack([number >> 8, number & 0xFF]).astype(np.uint8)


def _text(array: NDArray[np.uint8] | NDArray[np.uint16]) -> str:
    return base64.b64encode(zlib.compress(array.tobytes(), _LEVEL)).decode("ascii")
