"""Names as long as they may be, without a place to break, fit the pages of a phone."""

from __future__ import annotations

from pathlib import Path

from pydantic import SecretStr
from support.browser import Browser, browser_or_skip
from support.homes import make_home
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.app.measuring import planned_recordings
from sms_jobs.app.measuring.planned_recordings import InTime
from sms_jobs.app.work import new_jobs, schedules
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.records.people import Role

PHONE_PX = 390
PASSWORD = "correct horse battery"
LONG = "W" * 64


def test_the_longest_names_fit_a_phone(home: Path, tmp_path: Path) -> None:
    make_home(home, {}, LONG)
    with bootstrap.services(home) as services:
        schedules.add(services, LONG, "every 1h", Work(LONG, ("simulate",)))
        job = new_jobs.submit(services, Work(LONG, ("simulate",), run=LONG)).job_ids[0]
        planned_recordings.plan(services, LONG, InTime(), ["S00", "S01"])
        people.add(services, LONG, Role.ADMINISTRATOR, SecretStr(PASSWORD))
    wide = {}
    with serving(home) as site, Browser(browser_or_skip(), tmp_path / "profile") as page:
        page.screen(PHONE_PX, 900)
        page.visit(f"{site}/login")
        page.write("#name", LONG)
        page.write("#password", PASSWORD)
        page.leave_by("button.main")
        for path in ("", "campaigns", f"campaigns/{LONG}", f"jobs/{job}", f"runs/{LONG}", "recordings",
                     f"recordings?campaign={LONG}", "schedules", "archive/1", "people", f"people/{LONG}",
                     f"campaigns/{5 * LONG}"):  # fmt: skip
            page.visit(f"{site}/{path}")
            width = page.run("document.documentElement.scrollWidth")
            if width > PHONE_PX:
                wide[path] = width
    assert wide == {}
