"""What a job or a file is about: how it is written, read, and taken apart."""

from __future__ import annotations

from itertools import product

import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.records.subject import Subject, checked_name

TUPLE, STATE, CAMPAIGN = Subject("wing", "S01", "C1P2"), Subject("wing", "S01"), Subject("wing")
EVERY = (TUPLE, STATE, CAMPAIGN, Subject("wing", "S010"), Subject("wing-2", "S01", "C1P2"))


@pytest.mark.parametrize("one", EVERY, ids=str)
def test_what_is_written_is_read(one: Subject) -> None:
    assert Subject.parse(str(one)) == one


@pytest.mark.parametrize("text", ["", "/", "wing/", "wing//C1P2", "wing/S01/C1P2/strain", "wing/../C1P2"])
def test_what_is_no_subject_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput):
        Subject.parse(text)


def test_a_subject_covers_itself_and_its_parts() -> None:
    covered = [(a, b) for a, b in product(EVERY, repeat=2) if a.covers(b)]
    assert all(a == b or str(b).startswith(f"{a}/") for a, b in covered)
    # Each covers itself, the campaign three more of its own, and the state its tuple.
    assert len(covered) == len(EVERY) + 3 + 1


def test_a_subject_is_called_by_its_parts() -> None:
    assert (TUPLE.at_state, STATE.at_state, CAMPAIGN.at_state) == (STATE, STATE, CAMPAIGN)
    assert (TUPLE.within, STATE.within, CAMPAIGN.within) == ("S01/C1P2", "S01", "wing")
    assert (TUPLE.in_filename, CAMPAIGN.in_filename) == ("wing-S01-C1P2", "wing")


def test_a_name_of_other_letters_is_refused_with_those_it_may_have() -> None:
    with pytest.raises(InvalidInput, match="use at most 64 of the letters a to z and A to Z, digits"):
        checked_name("Flügel", "campaign")
