"""Pages about what is no job follow it by events: what others do is seen without loading the page again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from support.browser import Browser, browser_or_skip
from support.homes import make_home
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.app.measuring import planned_recordings
from sms_jobs.app.measuring.planned_recordings import InTime
from sms_jobs.app.work import schedules
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.bootstrap import Services
from sms_jobs.jobs.archiving import acceptances
from sms_jobs.jobs.archiving.registration import register_calibration
from sms_jobs.jobs.scheduling.firing import fire_due
from sms_jobs.virtual_rig.campaigns import small_plate


@pytest.fixture(scope="module")
def services(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Services]:
    """A home with a campaign, as the service sees it."""
    home = tmp_path_factory.mktemp("follow") / "home"
    make_home(home, {})
    with bootstrap.services(home) as services:
        yield services


@pytest.fixture(scope="module")
def site(services: Services) -> Iterator[str]:
    with serving(services.settings.home) as address:
        yield address


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Browser]:
    with Browser(browser_or_skip(), tmp_path) as browser:
        browser.screen(1280, 900)
        yield browser


def watch(page: Browser, address: str) -> None:
    """Open a page that hears of changes by events alone, and know whether it is loaded again."""
    page.visit(address)
    # Nothing is fetched because time has passed.
    page.run("window.here = true; for (let k = setInterval(() => {}, 1e6); k > 0; k--) clearInterval(k)")


def see(page: Browser, region: str, words: str) -> None:
    page.wait_for(f"document.querySelector('#{region}').textContent.includes('{words}')")
    assert page.run("window.here")
    assert page.complaints == []


def test_schedules_are_followed(page: Browser, site: str, services: Services) -> None:
    watch(page, f"{site}/schedules")
    schedules.add(services, "nightly", "every 1h", Work("plate", ("simulate",)), zone="UTC", missed="skip")
    see(page, "schedules", "nightly")
    fire_due(services.catalogue, datetime.now(UTC) + timedelta(hours=1, seconds=1))
    see(page, "schedules", "submitted 2 jobs")
    fire_due(services.catalogue, datetime.now(UTC) + timedelta(hours=2.5))
    see(page, "schedules", "missed")
    schedules.set_paused(services, "nightly", True)
    see(page, "schedules", "paused")


def test_calibrations_are_followed(page: Browser, site: str, services: Services) -> None:
    watch(page, f"{site}/calibrations")
    first, _ = small_plate("plate")
    later = replace(first, origin="at noon", valid_from=first.valid_from + timedelta(days=1))
    register_calibration(services.catalogue, services.archive, later, datetime.now(UTC))
    see(page, "calibrations", "at noon")
    watch(page, f"{site}/calibrations/2")
    used = page.run("document.querySelector('#withdraw') !== null")
    for in_use in (not used, used):
        acceptances.accept(services.catalogue, services.archive, 2, None, datetime.now(UTC), in_use=in_use)
        see(page, "use", "Accepted" if in_use else "Withdrawn")
        page.wait_for(f"document.querySelector('{'#withdraw' if in_use else '#accept'}')")
        assert page.run("window.here")


def test_planned_recordings_are_followed(page: Browser, site: str, services: Services) -> None:
    watch(page, f"{site}/recordings?campaign=plate")
    planned_recordings.plan(services, "plate", InTime(), ["S00", "S01"])
    see(page, "planned", "plate/S00 is next")
    planned_recordings.hold(services, "plate", ["S01"])
    page.wait_for("document.querySelectorAll('#planned .state.asks').length === 1")
    planned_recordings.go(services, "plate")
    page.wait_for("document.querySelectorAll('#planned .state.asks').length === 0")
    planned_recordings.skip(services, "plate")
    see(page, "planned", "plate/S01 is next")


def test_what_is_refused_says_so_and_keeps_no_page_from_going_on(
    page: Browser, site: str, services: Services
) -> None:
    schedules.add(services, "twice", "every 1h", Work("plate", ("simulate",)), zone="UTC")
    schedules.add(services, "kept", "every 1h", Work("plate", ("simulate",)), zone="UTC")
    watch(page, f"{site}/schedules")
    page.click("#remove-twice")
    page.wait_for("document.querySelector('dialog').open")
    schedules.remove(services, "twice")  # in another window
    page.click("dialog button[value=yes]")
    page.wait_for("document.querySelector('#schedules .problem')?.textContent.includes('no schedule')")
    page.complaints.clear()  # the browser notes the refusal
    # The first change takes the button away, and those after it leave the refusal where it is.
    for paused in (True, False, True):
        schedules.set_paused(services, "kept", paused)
        page.wait_for(
            f"document.querySelector('#hold-kept').textContent === '{'Resume' if paused else 'Pause'}'"
        )
        assert page.run("document.querySelector('#remove-twice')") is None
        see(page, "schedules > .problem", "there is no schedule \\'twice\\'")
    # It is over once something else is done.
    page.click("#hold-kept")
    page.wait_for("document.querySelector('#hold-kept').textContent === 'Pause'")
    assert page.run("document.querySelector('#schedules .problem:not(:empty)')") is None
    schedules.remove(services, "kept")
