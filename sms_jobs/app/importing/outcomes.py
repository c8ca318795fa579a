"""What became of the tuples that were to be imported."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.importers.folders import LeftOut
from sms_jobs.formats.importers.inspection import Inspected
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign


@dataclass(frozen=True)
class TupleOutcome:
    """What became of a tuple.

    Attributes
    ----------
    state, view
        Which it is.
    frames
        How many files it has.
    size
        Columns and rows of its images, as text; None where none could be read.
    outcome
        imported, already there, would be imported, or refused.
    detail
        Where it lies, or why it was refused.
    """

    state: str
    view: str
    frames: int
    size: str | None
    outcome: str
    detail: str


@dataclass(frozen=True)
class Outcome:
    """What became of every tuple, in order, what there is to say, and which files were not taken."""

    tuples: tuple[TupleOutcome, ...]
    remarks: tuple[str, ...]
    left_out: tuple[LeftOut, ...] = ()

    @property
    def bad(self) -> bool:
        """Whether a tuple was refused."""
        return any(one.outcome == "refused" for one in self.tuples)


@use_case(Right.READ)
def existing_campaign(services: Services, name: str, rig: str | None = None) -> Campaign | None:
    """Return a campaign; None where there is none of that name.

    Raises `InvalidInput` where it is measured by another rig than the one that is named.
    """
    with services.catalogue.reading() as session:
        try:
            existing = campaigns.definition(campaigns.campaign_row(session, name))
        except NotFound:
            return None
    if rig not in (None, existing.rig):
        raise InvalidInput(
            f"campaign {name} is measured by rig {existing.rig}, which stays: leave out `rig`, or import "
            "into another campaign"
        )
    return existing


def outcome_of(one: Inspected, outcome: str, detail: str) -> TupleOutcome:
    """Return what is reported of a tuple."""
    facts = next(iter(one.facts.values()), None)
    return TupleOutcome(
        one.found.state,
        one.found.view,
        len(set(one.found.files)),
        None if facts is None else f"{facts.columns} x {facts.rows}",
        outcome,
        detail,
    )
