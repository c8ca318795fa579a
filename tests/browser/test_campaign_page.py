"""The matrix of a campaign: why a cell is stale or failed is read by keys, and pictures are small."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select, update
from support.browser import Browser, browser_or_skip
from support.homes import make_home, stored
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.app.work import new_jobs
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.files import ResultRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.kinds import all_kinds
from sms_jobs.records.fields import Surface
from sms_jobs.records.job import JobState

WHY = "document.querySelector('#why-tuples-S00-C1P1-reconstruct')"
PICTURE = "document.querySelector('#matrix img')"


@pytest.fixture
def services(home: Path) -> Iterator[Services]:
    """A home with a stale surface, whose jobs wait."""
    make_home(home, {})
    with bootstrap.services(home) as services:
        new_jobs.submit(services, Work("plate", ("simulate", "pipeline")))
        y, x = np.mgrid[0:60, 0:80].astype(float)
        record = Surface("C1P1", "mm", np.stack([x, y, x * y]), np.zeros((60, 80), np.uint32))
        file = stored(services, "reconstruct", "plate/S00/C1P1", {"surface": record})
        with services.catalogue.writing() as session:
            older = all_kinds()["reconstruct"].version - 1
            session.add(ResultRow(file_id=file, kind="reconstruct", kind_version=older))
            session.execute(
                update(JobRow).where(JobRow.kind == "reconstruct").values(state=JobState.SUCCEEDED)
            )
        yield services


def fail(services: Services, kind: str, error: str) -> None:
    """Let the first job of a kind fail, as the service tells it."""
    with services.catalogue.writing() as session:
        job = session.scalars(select(JobRow).where(JobRow.kind == kind).order_by(JobRow.position)).first()
        assert job is not None
        job.state, job.error = JobState.FAILED, error
        session.add(EventRow(job_id=job.id, at=datetime.now(UTC), state=job.state, attempt=1, message=error))


def test_why_is_read_by_keys_and_stays_open_while_the_page_follows(
    services: Services, tmp_path: Path
) -> None:
    with (
        serving(services.settings.home) as site,
        Browser(browser_or_skip(), tmp_path / "profile") as page,
    ):
        page.screen(1280, 900)
        page.visit(f"{site}/campaigns/plate")
        page.run("window.here = true")
        assert not page.run(f"{WHY}.open")
        page.run(f"{WHY}.querySelector('summary').focus()")
        page.key("Enter", "\r")
        page.wait_for(f"{WHY}.open")
        assert "is now version" in page.run(f"{WHY}.querySelector('p').innerText")
        assert page.run(f"{WHY}.querySelector('p').checkVisibility()")
        assert page.run("document.activeElement.innerText").startswith(("Why", "▾"))

        page.run(f"{PICTURE}.scrollIntoView()")
        page.wait_for(f"{PICTURE}.complete && {PICTURE}.naturalWidth > 0")
        assert page.run(f"{PICTURE}.getBoundingClientRect().width") == 72
        assert page.run(f"{PICTURE}.alt") == "reconstruct S00 C1P1"

        fail(services, "assess", "no fringe is seen; light the <b>specimen</b>")
        failed = "document.querySelector('#why-tuples-S00-C1P1-assess p')"
        page.wait_for(f"{failed}?.textContent === 'No fringe is seen; light the <b>specimen</b>.'")
        assert page.run(f"{WHY}.open")
        assert page.run("window.here")
        assert page.complaints == []


def test_an_emptied_priority_is_the_usual_one(services: Services, tmp_path: Path) -> None:
    with (
        serving(services.settings.home) as site,
        Browser(browser_or_skip(), tmp_path / "profile") as page,
    ):
        page.screen(1280, 900)
        page.visit(f"{site}/campaigns/plate?kind=simulate")
        page.run("document.querySelector('#priority').value = ''")
        page.click("#estimate")
        page.wait_for("document.querySelector('#submit .outcome').textContent.includes('Would submit 2')")
        assert page.complaints == []


def test_one_job_is_told_as_one(services: Services, tmp_path: Path) -> None:
    with (
        serving(services.settings.home) as site,
        Browser(browser_or_skip(), tmp_path / "profile") as page,
    ):
        page.screen(1280, 900)
        page.visit(f"{site}/campaigns/plate?kind=simulate")
        page.run("document.querySelector('#which').open = true")
        page.click("#submit input[name=states][value=S00]")
        page.click("#estimate")
        told = "document.querySelector('#submit .outcome').textContent"
        page.wait_for(f"{told}.includes('Would submit 1 job: 1 simulate')")
        page.click("#submit input[name=views][value=C1P1]")
        page.click("#estimate")
        refused = "has no effect on it: submit simulate without it"
        page.wait_for(f"document.querySelector('#submit').textContent.includes('{refused}')")
