"""Under which conditions a campaign was measured: what a reader of a publication asks for."""

from __future__ import annotations

from dataclasses import dataclass

NOT_RECORDED = "not recorded"


@dataclass(frozen=True)
class Condition:
    """One of them.

    Attributes
    ----------
    group
        Heading of the table that it stands in.
    name
        What was asked.
    about
        The camera, view or states that it holds for; empty for the whole campaign.
    value
        The answer with its unit, in words; `NOT_RECORDED` where the archive does not know.
    """

    group: str
    name: str
    about: str
    value: str = NOT_RECORDED
