"""What jobs remark about their data is told to whoever waits for them, also at a server."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from sqlalchemy import update
from support.homes import make_home
from support.serving import serving

import sms_jobs
from sms_jobs import bootstrap
from sms_jobs.app.measuring.recordings import Recorded
from sms_jobs.app.work import new_jobs
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.app.work.waiting import Waited
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.cli import acquire, waiting
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.remarks import Remarks


def test_remarks_come_with_the_answer(home: Path) -> None:
    make_home(home, {})
    with bootstrap.services(home) as services:
        done = new_jobs.submit(services, Work("plate", ("simulate", "reconstruct")))
        with services.catalogue.writing() as session:
            session.execute(update(JobRow).values(state=JobState.SUCCEEDED, message="took 1.0 s; seen"))
            dark = JobRow.kind == "reconstruct"
            session.execute(update(JobRow).where(dark).values(message="took 1.0 s; note: it is dark"))
    about = tuple(f"plate/{state}/{view}" for state in ("S00", "S01") for view in ("C1P1", "C1P2"))[:3]
    told = (Remarks("reconstruct", 4, tuple(f"{one}: it is dark" for one in about)),)
    with sms_jobs.open(home) as lab:
        assert lab.wait(done).remarks == told
    with serving(home) as site, sms_jobs.connect(site) as lab:
        assert lab.wait(done).remarks == told


DARK = Remarks("acquire", 4, tuple(f"plate/S0{number}: it is dark" for number in range(3)))


def test_people_see_the_first_of_a_kind_and_where_the_others_are(capsys: pytest.CaptureFixture[str]) -> None:
    waiting.tell_remarks(Waited({"succeeded": 4}, remarks=(DARK,)))
    assert capsys.readouterr().err.splitlines() == [
        *(f"note: acquire {one}" for one in DARK.first),
        "note: 1 more job of acquire remarks something: see 'sms job list --kind acquire'",
    ]


def test_programs_see_those_of_recordings(capsys: pytest.CaptureFixture[str]) -> None:
    followed = acquire._Followed(as_json=True)
    followed._turns.append(Recorded(Waited({"succeeded": 4}, remarks=(DARK,)), ()))
    followed.end()
    told = json.loads(capsys.readouterr().out)
    assert told["remarks"] == [{"kind": "acquire", "jobs": 4, "first": list(DARK.first)}]
