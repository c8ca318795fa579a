"""Named lists of fringe densities: the thesis's sequences, and those of other people's rigs."""

from __future__ import annotations

import re
from collections.abc import Callable
from math import ceil, log

from sms_jobs.errors import InvalidInput

_NAME = re.compile(r"([a-z-]+)-([1-9][0-9]{0,2})")
_LARGEST_RATIO = 8.0  # of neighbours in a multi-frequency set: at B = 20 sigma an order is lost once in 10^8


def ranging(fringes: int) -> tuple[int, ...]:
    """Return 0 .. s-1, the densities of Fourier domain ranging with a known origin (thesis section 7.2.2)."""
    return tuple(range(fringes))


def linear(fringes: int) -> tuple[int, ...]:
    """Return 1 .. s, the linear sequence (thesis Fig. 10)."""
    return tuple(range(1, fringes + 1))


def _powers_below(fringes: int) -> list[int]:
    return [1 << i for i in range(fringes.bit_length()) if 1 << i < fringes]


def forward_exponential(fringes: int) -> tuple[int, ...]:
    """Return 1, 2, 4 .. s, the forward exponential sequence (thesis Fig. 10)."""
    return (*_powers_below(fringes), fringes)


def reverse_exponential(fringes: int) -> tuple[int, ...]:
    """Return s, s-1, s-2, s-4 .. s/2, the reverse exponential sequence (thesis Fig. 10)"""
    return (fringes, *(fringes - step for step in _powers_below(fringes) if 2 * step <= fringes))


def multi_frequency(fringes: int) -> tuple[int, ...]:
    """Return 1 .. s in equal ratios of at most 8, as few as can be: (1, 4, 16), (1, 8, 64)."""
    climbs = ceil(log(fringes, _LARGEST_RATIO) - 1e-9)
    return tuple(sorted({1, *(round(fringes ** (i / climbs)) for i in range(1, climbs + 1))}))


SEQUENCES: dict[str, Callable[[int], tuple[int, ...]]] = {
    "fdr": ranging,
    "linear": linear,
    "forward-exponential": forward_exponential,
    "reverse-exponential": reverse_exponential,
    "multi-frequency": multi_frequency,
}
"""By the name that people write, without the number of fringes."""


def named_sequence(name: str) -> tuple[int, ...]:
    """Return the densities of a name such as `fdr-64`; raise `InvalidInput` for an unknown one."""
    found = _NAME.fullmatch(name)
    if found is None or found[1] not in SEQUENCES or int(found[2]) < 2:
        known = ", ".join(f"{one}-S" for one in SEQUENCES)
        raise InvalidInput(
            f"there is no fringe sequence '{name}': write a list, or {known} with S from 2 to 999"
        )
    return SEQUENCES[found[1]](int(found[2]))
