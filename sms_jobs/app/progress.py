"""How a use case tells how far it has come."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True)
class Step:
    """How far something has come.

    Attributes
    ----------
    doing
        In one word, as "verifying".
    done, total
        Files, tuples or bytes, as the use case says; None where the total is not known yet.
    detail
        What of it is being done just now.
    """

    doing: str
    done: int
    total: int | None
    detail: str = ""


Tell: TypeAlias = Callable[[Step], None]
"""Called with each step; what it raises ends the use case."""


def nobody(step: Step) -> None:
    """Tell nobody."""
