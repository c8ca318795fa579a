"""Gray code of stripes: which stripes of the projector a pixel may see, and whether frames are such a code.

Pattern b of n, the coarsest first, is bright where bit b of the stripe's Gray code is set; neighbouring
stripes differ in one pattern only. A bit that is lost in noise leaves several stripes: one on a
border leaves the two beside it, and patterns too fine to be seen leave the stripe of a coarser code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from math import pi

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.phase.temporal_unwrapping import CoarseGradient

UNREAD = -1
"""Number of a stripe that cannot be read."""

_MOST_DOUBTFUL = 3  # bits of a pixel
_LEAST_BORDERS = 20  # pairs of neighbouring pixels between which a bit changes, to judge it by
_NEXT = 0.5  # of them at least are of neighbouring stripes, or something is wrong
_EXPLAINED = 0.8

Numbers = NDArray[np.int32]


@dataclass(frozen=True)
class StripeRange:
    """Stripes that agree with the bits a pixel shows.

    Attributes
    ----------
    stripe
        (rows, columns): the one that is read, doubtful bits as they are; `UNREAD` where none can be.
    middle
        (rows, columns): middle of those that agree, in stripes from the projector's edge; NaN where unread.
    width
        (rows, columns): how many they are.
    """

    stripe: Numbers
    middle: NDArray[np.float64]
    width: NDArray[np.float64]

    @property
    def nearly_sure(self) -> Numbers:
        """The stripes that are read with one bit in doubt at most; `UNREAD` elsewhere."""
        return np.where(self.width <= 2.0, self.stripe, np.int32(UNREAD))


def read_stripes(
    above: NDArray[np.float32],
    doubt: NDArray[np.float32],
    stripes: float,
    at_border: NDArray[np.bool_] | bool = False,
) -> StripeRange:
    """Return the stripes that every pixel may see.

    Parameters
    ----------
    above
        (bits, rows, columns), grey levels above the threshold, the coarsest first: positive is a set bit.
    doubt
        Of the same shape, or one that is broadcast to it: distance from the threshold below which a bit may
        be either.
    stripes
        How many go across the projector; words beyond them cannot be.
    at_border
        Of the shape of `above`, or one that is broadcast to it: where a doubtful bit is so within half a
        stripe of a border alone, since its pattern is seen clearly near by.

    Notes
    -----
    With d doubtful bits 2^d words agree with the others; they count where they are stripes one beside the
    other, d is 3 at most. Of two stripes a pixel at their border sees half of each.
    """
    bits = len(above)
    doubtful = np.abs(above) < np.broadcast_to(doubt, above.shape)
    stripe, turned = np.zeros((2, *above.shape[1:]), np.int32)
    unsure = np.zeros(above.shape[1:], np.int32)
    for level, one in zip(above, doubtful, strict=True):
        # A Gray code is read from the coarsest pattern on: each set bit turns those that follow.
        turned ^= level > 0.0
        stripe = (stripe << 1) | turned
        unsure = (unsure << 1) | one
    number = doubtful.sum(axis=0)
    first, last, left = stripe.copy(), stripe.copy(), unsure.copy()
    flips = [np.zeros_like(stripe)]
    for _ in range(min(_MOST_DOUBTFUL, bits)):
        lowest = left & -left
        left ^= lowest
        # Another bit turns itself and all finer ones of the number.
        turn = np.where(lowest > 0, 2 * lowest - 1, 0)
        flips += [before ^ turn for before in flips]
    for flip in flips:
        np.minimum(first, stripe ^ flip, out=first)
        np.maximum(last, stripe ^ flip, out=last)
    read = (number <= _MOST_DOUBTFUL) & (last - first + 1 == 1 << np.minimum(number, 30)) & (first < stripes)
    width = np.minimum(last + 1.0, stripes) - first
    border = (number == 1) & (width == 2.0) & np.any(doubtful & at_border, axis=0)
    return StripeRange(
        np.where(read, stripe, UNREAD).astype(np.int32),
        np.where(read, first + 0.5 * width, np.nan),
        np.where(border, 1.0, width),
    )


def gradient_at(place: NDArray[np.float64], stripes: float) -> NDArray[np.float64]:
    """Return omega = 2 pi (place / stripes - 1/2) at places in stripes from the projector's edge."""
    return 2.0 * pi * (place / stripes - 0.5)


def gradient_of_stripes(stripe: Numbers, stripes: float) -> CoarseGradient:
    """Return the phase gradient at the middle of stripes of which `stripes` go across the projector.

    omega = 2 pi ((stripe + 1/2) / stripes - 1/2), and the truth is within pi / stripes of it.
    """
    middle = gradient_at(stripe.astype(np.float64) + 0.5, stripes)
    return CoarseGradient(np.where(stripe == UNREAD, np.nan, middle), pi / stripes)


def order_mishap(stripe: Numbers, bits: int) -> str | None:
    """Say what is wrong with the order of patterns, by the stripes of neighbouring pixels; None for nothing.

    Parameters
    ----------
    stripe
        (rows, columns), `UNREAD` where it is not sure.

    Notes
    -----
    Where the words of two neighbouring pixels differ in one bit their stripes are neighbours, whatever the
    surface, while a stripe is no narrower than half a pixel. Of each bit at least half of such pairs have to
    be; of explanations the one counts of whose borders 80 % are. Patterns that count in plain binary differ
    in one bit between every second pair of stripes alone, and those are neighbours in a Gray code too: taken
    as plain numbers the words of all pairs are neighbours, of a Gray code those of half of them.
    """
    pairs = _differing(stripe)
    words = (word_of(pairs[0]), word_of(pairs[1]))
    if _beside(words) >= _EXPLAINED > _beside(pairs):
        return "the patterns are a plain binary code, not a Gray code"
    if _agreement(words, bits, lambda word: word) >= _NEXT:
        return None
    best, most = "the patterns are not in the order that is told: see order, bits and first", _EXPLAINED
    for text, change in explanations(bits):
        share = _agreement(words, bits, change)
        if share > most:
            best, most = text, share
    return best


def word_of(number: Numbers) -> Numbers:
    """Return the word of the Gray code of a stripe."""
    return number ^ (number >> 1)


def number_of(word: Numbers) -> Numbers:
    """Return the stripe of a word: a bit of it is the exclusive or of all bits above."""
    number = word.copy()
    for shift in (1, 2, 4, 8):
        number ^= number >> shift
    return number


def _differing(stripe: Numbers) -> tuple[Numbers, Numbers]:
    """Return the stripes of neighbouring pixels, in rows and columns, where they are read and differ."""
    one = np.concatenate([stripe[:, :-1].ravel(), stripe[:-1].ravel()])
    other = np.concatenate([stripe[:, 1:].ravel(), stripe[1:].ravel()])
    used = (one != UNREAD) & (other != UNREAD) & (one != other)
    return one[used], other[used]


def _beside(pairs: tuple[Numbers, Numbers]) -> float:
    """Return the share of pairs that differ by one; 0 of fewer than tell anything."""
    near = np.abs(pairs[0] - pairs[1]) == 1
    return float(near.mean()) if near.size >= _LEAST_BORDERS else 0.0


def _agreement(words: tuple[Numbers, Numbers], bits: int, change: Callable[[Numbers], Numbers]) -> float:
    """Return the share of neighbouring stripes at borders of the bit where it is least; 1 of no borders."""
    one, other = change(words[0]), change(words[1])
    differ = one ^ other
    beside = np.abs(number_of(one) - number_of(other)) == 1
    each = [beside[differ == 1 << k] for k in range(bits)]
    return min((float(b.mean()) for b in each if b.size >= _LEAST_BORDERS), default=1.0)


def explanations(bits: int) -> list[tuple[str, Callable[[Numbers], Numbers]]]:
    """Return what may be wrong with the order of patterns, and the words with that repaired."""

    def ordered(places: list[int]) -> Callable[[Numbers], Numbers]:
        def change(word: Numbers) -> Numbers:
            found = np.zeros_like(word)
            for to, place in enumerate(places):
                found |= ((word >> place) & 1) << to
            return found

        return change

    def inverted(k: int) -> Callable[[Numbers], Numbers]:
        return lambda word: word ^ np.int32(1 << k)

    found = []
    if bits > 2:
        found.append(("the patterns are shown in the other order: set order", ordered([*range(bits)][::-1])))
    for i, j in combinations(range(bits), 2):
        places = list(range(bits))
        places[i], places[j] = j, i
        found.append((f"bits {bits - 1 - j} and {bits - 1 - i} have changed places", ordered(places)))
    found += [
        (f"bit {bits - 1 - k} is inverted: bright and dark of its pattern have changed places", inverted(k))
        for k in range(bits)
    ]
    return found
