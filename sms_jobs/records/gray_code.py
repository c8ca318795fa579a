"""A Gray code of stripes: its patterns, and what tells bright from dark in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sms_jobs.errors import InvalidInput

LARGEST_BITS = 16
"""Most patterns of a Gray code in one orientation."""

Threshold = Literal["inverse", "white-black", "fringes"]


@dataclass(frozen=True)
class GrayCode:
    """Patterns of stripes: neighbouring stripes of the projector differ in one of them.

    Attributes
    ----------
    bits
        Patterns of each orientation, the coarsest first.
    stripes
        How many stripes go across the projector, one number or one for each orientation; 2^bits where they
        fill it.
    threshold
        Above which grey level a bit is set: that of the inverse pattern, the mean of the white and the black
        frame, or the mean of the pixel's fringe frames, where there are any.
    """

    bits: int
    stripes: tuple[float, ...]
    threshold: Threshold = "inverse"

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= LARGEST_BITS:
            raise InvalidInput(f"a Gray code has 1 to {LARGEST_BITS} patterns, not {self.bits}")
        if not self.stripes or not all(2.0 <= s <= 2**self.bits for s in self.stripes):
            raise InvalidInput(
                f"a Gray code of {self.bits} patterns has 2 to {2**self.bits} stripes across the projector, "
                f"not {', '.join(f'{s:g}' for s in self.stripes) or 'none'}"
            )

    def stripes_of(self, orientation: int) -> float:
        """Return how many stripes there are in an orientation, by its number."""
        return self.stripes[orientation if len(self.stripes) > 1 else 0]

    @property
    def frames_each(self) -> int:
        """How many frames an orientation has, without white and black."""
        return 2 * self.bits if self.threshold == "inverse" else self.bits

    def frames(self, orientations: int) -> int:
        """Return how many frames there are: orientation by orientation, each pattern before its inverse.

        White and black come last, once for all orientations.
        """
        return orientations * self.frames_each + (2 if self.threshold == "white-black" else 0)

    @property
    def in_words(self) -> str:
        """Bits and thresholds: a Gray code of 10 bits with inverses."""
        beside = {"inverse": " with inverses", "white-black": " with white and black", "fringes": ""}
        return f"a Gray code of {self.bits} bits{beside[self.threshold]}"


@dataclass(frozen=True)
class Stripes:
    """One pattern of a Gray code.

    Attributes
    ----------
    orientation_rad
        Direction in which the stripes are counted.
    bits, stripes
        Of the code in this orientation.
    bit
        Which is shown, 0 the coarsest; None for a uniform field.
    inverted
        Whether bright and dark are exchanged: the inverse of a pattern, black in place of white.
    """

    orientation_rad: float
    bits: int
    stripes: float
    bit: int | None
    inverted: bool = False
