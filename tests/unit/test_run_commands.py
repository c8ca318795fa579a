"""`sms run` and what names runs: wrong input is one sentence and changes nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from support.homes import make_home
from typer.testing import CliRunner

from sms_jobs.cli.app import app
from sms_jobs.errors import Conflict, InvalidInput, NotFound, SmsError


def sms(home: Path, *words: str) -> Any:
    done = CliRunner().invoke(app, [*words, "--home", str(home)])
    if isinstance(done.exception, SmsError):
        raise done.exception
    return done


@pytest.fixture
def home(home: Path) -> Path:
    make_home(home, {})
    return home


def runs(home: Path) -> list[Any]:
    return list(json.loads(sms(home, "run", "list", "--json").stdout))


def test_a_run_is_shown_and_dropped_where_somebody_says_so(home: Path) -> None:
    assert "no run" in sms(home, "run", "list").stderr
    sms(home, "job", "submit", "simulate", "-c", "plate", "--run", "first", "--state", "S01")
    assert [one["name"] for one in runs(home)] == ["first"]
    shown = sms(home, "run", "show", "first")
    assert "1 queued" in shown.stdout
    assert "no result yet: simulate plate/S01 is queued" in shown.stderr
    with pytest.raises(InvalidInput, match="give --yes"):
        sms(home, "run", "drop", "first")
    assert len(runs(home)) == 1
    assert "its results stay" in sms(home, "run", "drop", "first", "--yes").stderr
    assert runs(home) == []
    assert len(json.loads(sms(home, "job", "list", "--json").stdout)) == 1


@pytest.mark.parametrize(
    ("words", "error", "said"),
    [
        ("run show none", NotFound, "there is no run 'none'; name one with"),
        ("run keep none", NotFound, "there is no run 'none'"),
        ("run drop none --yes", NotFound, "there is no run 'none'"),
        ("run compare none other", NotFound, "there is no run 'none'"),
        ("run compare one one", InvalidInput, "is compared with itself"),
        ("run compare a b -o page.pdf", InvalidInput, "must end in .html or .csv"),
        ("job submit pipeline -c plate --run a/b", InvalidInput, "'a/b' cannot be the name of a run"),
        ("job submit pipeline --run today", InvalidInput, "--campaign, or states with --where"),
        ("job submit pipeline -c plate --where load_N>1", InvalidInput, "--campaign, or states with --where"),
        ("job submit simulate --where load_N>1 --wait", InvalidInput, "--wait is for one campaign"),
        ("job submit simulate --where load_N>1e6 --run today", NotFound, "no state meets 'load_N>1e6'"),
        ("job submit pipeline --where load_N>1 --run today", NotFound, "needs the measurement"),
        (
            "job watch 3f2a -c plate",
            InvalidInput,
            "name jobs or a campaign, not both: 3f2a and `campaign` plate",
        ),
        ("job cancel 3f2a 4e -c plate", InvalidInput, "not both: 3f2a, 4e and `campaign` plate"),
        ("job submit report -c plate --state S01", InvalidInput, "by `state` has no effect on it"),
        ("schedule add n report -c plate --every 1h --state S01", InvalidInput, "by `state` has no effect"),
        ("schedule add n simulate --every 1h", InvalidInput, "--campaign, or states with --where"),
        ("schedule add n simulate -c plate --every 1h --run -x-", InvalidInput, "name of a run"),
    ],
)
def test_wrong_input_changes_nothing(home: Path, words: str, error: type[SmsError], said: str) -> None:
    with pytest.raises(error) as refused:
        sms(home, *words.split())
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
    assert runs(home) == []
    assert json.loads(sms(home, "job", "list", "--json").stdout) == []
    assert json.loads(sms(home, "schedule", "list", "--json").stdout) == []


def test_schedules_are_listed_with_the_unit_of_their_interval(home: Path) -> None:
    sms(home, "schedule", "add", "hourly", "simulate", "-c", "plate", "--every", "3600s")
    assert "every 1 h " in sms(home, "schedule", "list").stdout
    (shown,) = json.loads(sms(home, "schedule", "list", "--json").stdout)
    assert shown["expression"] == "every 3600"


def test_what_has_not_ended_is_not_kept(home: Path) -> None:
    sms(home, "job", "submit", "simulate", "-c", "plate", "--run", "first")
    with pytest.raises(Conflict, match="2 jobs of run 'first' have not ended"):
        sms(home, "run", "keep", "first")
