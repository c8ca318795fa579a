"""What jobs remark about their data is told to whoever waits for them, also at a server."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path

import pytest
from sqlalchemy import select, update
from support.command import inside
from support.homes import make_home
from support.serving import serving

import sms_jobs
from sms_jobs import bootstrap
from sms_jobs.app.measuring.recordings import Recorded
from sms_jobs.app.work import new_jobs
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.app.work.waiting import Waited
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.cli import acquire, demo, waiting
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
    waiting.tell_remarks([DARK])
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


def test_who_watches_jobs_is_told_like_who_waits_for_them(home: Path) -> None:
    make_home(home, {})
    with bootstrap.services(home) as services:
        new_jobs.submit(services, Work("plate", ("simulate",)))
        with services.catalogue.writing() as session:
            said = "took 1.0 s; note: it is dark"
            session.execute(update(JobRow).values(state=JobState.SUCCEEDED, message=said))
        with services.catalogue.reading() as session:
            jobs = session.scalars(select(JobRow.id)).all()
    known = ("job", "watch", *jobs, "--home", str(home))
    watched = inside(*known)
    assert watched.stdout == f"{len(jobs)} succeeded\n"
    assert "note: simulate plate/S00: it is dark\n" in watched.stderr
    waited = json.loads(inside("job", "wait", *known[2:], "--json").stdout)
    assert waited["remarks"][0]["jobs"] == len(jobs)
    assert json.loads(inside(*known, "--json").stdout.splitlines()[-1]) == waited


def test_the_demo_tells_what_its_jobs_remark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(demo, "_service", lambda _: nullcontext(lambda: None))
    monkeypatch.setattr(demo, "_print_summary", lambda _: None)
    monkeypatch.setattr("sms_jobs.app.home.demo.run", lambda *_, **__: ({"campaign": "plate"}, (DARK,)))
    demo.demo(out=tmp_path / "demo")
    assert f"note: acquire {DARK.first[0]}\n" in capsys.readouterr().err
    demo.demo(out=tmp_path / "demo", as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert told["remarks"] == [{"kind": "acquire", "jobs": 4, "first": list(DARK.first)}]
