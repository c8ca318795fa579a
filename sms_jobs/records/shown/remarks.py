"""What jobs remark about their data, as who waits for them is told."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Remarks:
    """What jobs of a kind remark about their data.

    Attributes
    ----------
    kind
        Theirs.
    jobs
        How many of them remark something.
    first
        What the first of them remark, each behind what it is about.
    """

    kind: str
    jobs: int
    first: tuple[str, ...]
