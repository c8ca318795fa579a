"""Long lists of values in parts: one statement may have a limited number of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

T = TypeVar("T")

AT_ONCE = 500


def parts(values: Sequence[T]) -> Iterator[Sequence[T]]:
    """Yield a list in parts of `AT_ONCE` values at most."""
    for first in range(0, len(values), AT_ONCE):
        yield values[first : first + AT_ONCE]
