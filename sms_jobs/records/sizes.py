"""Numbers of bytes, and of things, as people read them."""

from __future__ import annotations


def size(count: int) -> str:
    """Return a number of bytes as people read it."""
    amount = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if amount < 1000:
            return f"{amount:.0f} {unit}" if unit == "B" else f"{amount:.1f} {unit}"
        amount /= 1000
    return f"{amount:.1f} TB"


def number_of(count: int, thing: str) -> str:
    """Return how many there are of something: "1 view", "2 views"."""
    return f"{count} {thing}{'' if count == 1 else 's'}"
