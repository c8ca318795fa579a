"""What people read of how long jobs take."""

from __future__ import annotations

import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from sms_jobs.app.work.waiting import Waiting
from sms_jobs.cli.output import clock, duration
from sms_jobs.cli.waiting import estimate_text, followed
from sms_jobs.records.shown.estimates import Estimate, Outlook

NOW = datetime(2026, 3, 1, 21, 30, tzinfo=UTC)
KNOWN = Estimate(40, 0, 11_400.0, NOW + timedelta(seconds=11_400), 2, True, {}, (), ())


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.26, "0.3 s"),
        (45.4, "45 s"),
        (25 * 60.0, "25 min"),
        (11_400.0, "3 h 10 min"),
        (3 * 86_400.0 + 7_000.0, "3 d 2 h"),
    ],
)
def test_a_time_span_has_two_units_at_most(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_a_time_of_another_day_says_which() -> None:
    noon = datetime(2026, 3, 1, 12, 0).astimezone()
    assert clock(noon + timedelta(hours=1), noon) == "13:00"
    assert clock(noon + timedelta(hours=13), noon) == "2026-03-02 01:00"


def test_an_estimate_says_what_it_rests_on() -> None:
    ready = clock(KNOWN.ready_at or NOW, NOW)
    assert estimate_text(KNOWN, NOW) == f"about 3 h 10 min on 2 workers; ready {ready}"
    assert estimate_text(replace(KNOWN, reused=12), NOW).endswith("; 12 of 40 are reused")
    assert "once 'sms up' runs" in estimate_text(replace(KNOWN, alive=False, workers=1), NOW)
    assert estimate_text(replace(KNOWN, unknown={"merge": 3}), NOW) == (
        f"at least 3 h 10 min on 2 workers, not before {ready}; there is no history yet of merge (3)"
    )
    nothing = replace(KNOWN, seconds=None, ready_at=None, unknown={"merge": 40})
    assert estimate_text(nothing, NOW) == "no estimate: there is no history yet of merge (40)"
    told = estimate_text(replace(nothing, alive=False), NOW)
    assert told.endswith("merge (40); no worker is there: start one with 'sms up'")
    assert "no worker serves the queue io: start 'sms up'" in estimate_text(
        replace(nothing, unserved=("io",)), NOW
    )
    assert estimate_text(replace(KNOWN, reused=40), NOW) == "nothing has to be computed: 40 of 40 are reused"


def test_who_waits_without_a_terminal_is_told_what_would_never_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    passed_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: passed_s)

    def looks(estimate: Estimate) -> str:
        tell(Waiting({"queued": 40}, 40, "", Outlook(None, estimate)))
        return capsys.readouterr().err

    nobody = replace(KNOWN, alive=False)
    told = "waiting, with no end in sight: no worker is there: start one with 'sms up'\n"
    with followed() as tell:
        assert looks(nobody) == ""  # it may be about to start
        passed_s += 9.0
        assert (looks(nobody), looks(KNOWN)) == ("", "")
        passed_s += 9.0
        assert looks(nobody) == ""
        passed_s += 1.0
        assert (looks(nobody), looks(nobody)) == (told, "")
        assert "no worker serves the queue io: start 'sms up'" in looks(replace(nobody, unserved=("io",)))
        held = looks(replace(KNOWN, paused=("cpu", "io")))
        assert held.endswith("end in sight: the queue cpu, io is paused: 'sms queue list' says why\n")


def test_who_interrupts_the_waiting_is_told_that_the_jobs_go_on(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(KeyboardInterrupt), followed(stop="sms acquire abort"):
        raise KeyboardInterrupt
    said = "what was submitted goes on: 'sms job list' shows it, and 'sms acquire abort' stops it\n"
    assert capsys.readouterr().err.endswith(said)
    with pytest.raises(KeyboardInterrupt), followed():
        raise KeyboardInterrupt
    assert "goes on" not in capsys.readouterr().err
