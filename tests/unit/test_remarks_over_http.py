"""What jobs remark about their data is told to programs that wait for them at a server, too."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import update
from support.homes import make_home
from support.serving import serving

import sms_jobs
from sms_jobs import bootstrap
from sms_jobs.app.work import jobs
from sms_jobs.app.work.jobs import Work
from sms_jobs.catalogue.models import JobRow
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.remarks import Remarks


def test_remarks_come_with_the_answer(home: Path) -> None:
    make_home(home, {})
    with bootstrap.services(home) as services:
        done = jobs.submit(services, Work("plate", ("simulate", "reconstruct")))
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
