"""A state that there is not is refused wherever one is named, with the one that was perhaps meant."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.command import answer, inside
from support.homes import make_home

from sms_jobs.errors import did_you_mean

USAGE, NOT_FOUND = 2, 3


@pytest.fixture
def home(home: Path) -> Path:
    make_home(home, {})
    return home


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("job submit simulate -c plate --state S1", USAGE),
        ("schedule add n simulate -c plate --every 1h --state S1", USAGE),
        ("acquire run plate --dry-run --state S1", USAGE),
        ("acquire plan plate --next --state S1", USAGE),
        ("data export --kind measurement -c plate --state S1", USAGE),
        ("campaign matrix plate --state S1", NOT_FOUND),
        ("data find -c plate --state S1", NOT_FOUND),
        ("data states -c plate --state S1", NOT_FOUND),
    ],
)
def test_a_state_that_there_is_not_is_refused_with_the_one_like_it(home: Path, words: str, code: int) -> None:
    refused = inside(*words.split(), "--home", str(home))
    assert refused.returncode == code
    assert "campaign plate has no state S1; did you mean 'S01'; " in refused.stderr
    assert refused.stderr.count("\n") == 1
    for what in ("job", "schedule"):
        assert answer(what, "list", "--home", str(home)) == []


@pytest.mark.parametrize("what", ["find", "states"])
def test_a_state_that_no_campaign_has_is_not_found(home: Path, what: str) -> None:
    at = ("--home", str(home))
    refused = inside("data", what, "--state", "S1", *at)
    assert refused.returncode == NOT_FOUND
    assert "no campaign has a state S1; did you mean 'S01'; 'sms data states' shows" in refused.stderr
    # One that is there and has nothing yet, and what a query asks itself, have an answer, which is none.
    for there in (("--state", "S01", "--kind", "measurement"), ("measurement where state = S1",)):
        found = inside("data", what, *there, *at)
        assert (found.returncode, found.stdout) == (0, "")
        assert "there is no such" in found.stderr


@pytest.mark.parametrize("what", ["find", "states"])
def test_a_view_that_no_campaign_has_is_not_found(home: Path, what: str) -> None:
    at = ("--home", str(home))
    for of, said in (
        ((), "no campaign has a view C9; there are C1P1, C1P2\n"),
        (("-c", "plate"), "campaign plate has no view C9; there are C1P1, C1P2\n"),
    ):
        refused = inside("data", what, "--view", "C9", *of, *at)
        assert (refused.returncode, refused.stderr) == (NOT_FOUND, f"error: {said}")
    assert "view c1p1; did you mean 'C1P1'; there are" in inside("data", what, "--view", "c1p1", *at).stderr
    assert "no campaign has a view ''; there" in inside("data", what, "--view", "", *at).stderr
    # One that is there and has nothing yet, and what a query asks itself, have an answer, which is none.
    for there in (("--view", "C1P2", "--kind", "measurement"), ("measurement where view = C9",)):
        assert inside("data", "find", *there, *at).stderr == "there is no such file\n"


def test_campaigns_and_kinds_that_there_are_not_are_refused_with_the_one_like_it(home: Path) -> None:
    for words, code, said in (
        ("job list -c palte", NOT_FOUND, "no campaign 'palte'; did you mean 'plate'; the latest are plate"),
        ("job submit strian -c plate", USAGE, "no job kind 'strian'; did you mean 'strain'; choose one of"),
    ):
        refused = inside(*words.split(), "--home", str(home))
        assert (refused.returncode, refused.stderr.count("\n")) == (code, 1)
        assert said in refused.stderr


def test_names_are_alike_whatever_their_case_and_only_where_they_are() -> None:
    known = ("S00", "S01", "S10")
    assert did_you_mean("s01", known) == "did you mean 'S01'; "
    assert did_you_mean("S001", known) == "did you mean 'S01'; "
    assert did_you_mean("S99", known) == did_you_mean("load", known) == did_you_mean("S1", ()) == ""
