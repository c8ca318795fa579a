"""Displacement at every state against a calculation or another campaign."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sms_jobs.app.fields.field_comparison import ComparisonOptions, difference_of
from sms_jobs.app.rules import use_case
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns, search, subject_files
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.state_differences import StateDifference, draw_states, written_table
from sms_jobs.records.people import Right
from sms_jobs.records.recording import as_recorded
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    from sms_jobs.records.campaign import LoadState

_STATE = "{state}"


@dataclass(frozen=True)
class StateDifferences:
    """By how much displacements differ at every state, in order."""

    states: tuple[StateDifference, ...]

    def drawn(self, title: str) -> bytes:
        """Return maps of all states, and rms over the states, as PNG."""
        return draw_states(self.states, title)

    def table(self) -> bytes:
        """Return a row for each state as CSV."""
        return written_table(self.states)


@use_case(Right.READ)
def compare_states(
    services: Services, campaign: str, other: str, kind: str, how: ComparisonOptions
) -> StateDifferences:
    """Subtract another displacement from the merged one at every state that has both, but the first.

    Parameters
    ----------
    other
        Name of a mesh file with '{state}' for the label of the state, or of another campaign.
    kind
        What is compared: merge, or combine.

    Raises
    ------
    InvalidInput
        It is another kind, or what `difference_of` raises it for.
    NotFound
        There is no such campaign, or no state has both.
    """
    if kind not in ("merge", "combine"):
        raise InvalidInput(f"`kind` cannot be '{kind}'; choose merge or combine")
    pairs = _pairs(services, campaign, other, kind)
    return StateDifferences(
        tuple(_of_state(services, state, mine, theirs, how) for state, mine, theirs in pairs)
    )


def _pairs(services: Services, campaign: str, other: str, kind: str) -> list[tuple[LoadState, str, str]]:
    """Return the states that have both displacements: number of the file, and number or file of the other."""
    pairs: list[tuple[LoadState, str, str]] = []
    with services.catalogue.reading() as session:
        states = campaigns.definition(campaigns.campaign_row(session, campaign)).states
        if _STATE not in other:
            campaigns.campaign_id(session, other)
        for state in states[1:]:
            mine = subject_files.newest_file(
                session, kind, Subject(campaign, state.label), DATASET_MEDIA_TYPE
            )
            if _STATE in other:
                file = Path(other.replace(_STATE, state.label))
                theirs = str(file) if file.is_file() else None
            else:
                number = subject_files.newest_file(
                    session, kind, Subject(other, state.label), DATASET_MEDIA_TYPE
                )
                theirs = None if number is None else str(number)
            if mine is not None and theirs is not None:
                held = as_recorded(state, search.readings(session, mine))
                pairs.append((held, str(mine), theirs))
    if not pairs:
        raise NotFound(
            f"no state of {campaign} has both a {kind} and a displacement in {other}; submit the pipeline of "
            "the campaign, and look at the names of the files"
        )
    return pairs


def _of_state(
    services: Services, state: LoadState, mine: str, theirs: str, how: ComparisonOptions
) -> StateDifference:
    found = difference_of(services, mine, theirs, how)
    return StateDifference(
        state.label,
        state.known_load_n,
        state.known_displacement_mm,
        found.points[found.valid],
        np.linalg.norm(found.difference[found.valid], axis=1),
        float(found.facts()["stated_sigma_mm"]),
    )
