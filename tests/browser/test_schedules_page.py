"""The page of schedules: a month of coming firings, gone through by keys, and parameters of a kind."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from support.browser import Browser, browser_or_skip
from support.homes import make_home
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.app.work import schedules
from sms_jobs.app.work.new_jobs import Work

TARGET_PX = 44
CHOSEN = "document.activeElement.id"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The console of a home with a schedule for every hour and one for every night."""
    home = tmp_path_factory.mktemp("schedules") / "home"
    make_home(home, {})
    with bootstrap.services(home) as services:
        schedules.add(services, "hourly", "cron 0 * * * *", Work("plate", ("simulate",)), zone="UTC")
        schedules.add(services, "nightly", "cron 30 23 * * *", Work("plate", ("simulate",)), zone="UTC")
    with serving(home) as address:
        yield address


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Browser]:
    with Browser(browser_or_skip(), tmp_path) as browser:
        browser.screen(1280, 900)
        yield browser


def press(page: Browser, key: str) -> None:
    for kind in ("rawKeyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)


def test_a_month_is_gone_through_by_keys_and_fits_a_phone(page: Browser, site: str) -> None:
    today = datetime.now(UTC).date()
    following = (today.replace(day=1) + timedelta(days=32)).replace(day=15)
    page.visit(f"{site}/schedules?month={following:%Y-%m}")
    day = f"document.querySelector('#day-{following}').textContent"
    assert "00:00 hourly" in page.run(day)
    assert "23:30 nightly" in page.run(day)
    page.run(f"document.querySelector('#day-{following}').focus()")
    for key, days in (("ArrowRight", 1), ("ArrowDown", 8), ("ArrowLeft", 7), ("ArrowUp", 0)):
        press(page, key)
        assert page.run(CHOSEN) == f"day-{following + timedelta(days=days)}"
    with page.leaving():
        page.run("document.activeElement.click()")
    assert "hourly: simulate of plate at" in page.run("document.querySelector('#calendar').textContent")
    assert "and 23 times after that" in page.run("document.querySelector('#calendar').textContent")
    page.screen(390, 900)
    assert page.run("document.documentElement.scrollWidth") <= 390
    assert page.run(f"document.querySelector('#day-{following}').getBoundingClientRect().height") >= TARGET_PX
    assert page.run(f"document.querySelector('#day-{following}').getBoundingClientRect().width") >= TARGET_PX
    page.run(f"document.querySelector('#day-{following}').focus()")
    with page.leaving():
        press(page, "PageDown")
    assert page.run("new URLSearchParams(location.search).get('month')") > f"{following:%Y-%m}"
    assert page.complaints == []


def test_a_schedule_takes_the_parameters_of_its_kind(page: Browser, site: str) -> None:
    page.visit(f"{site}/schedules")
    assert page.run("document.querySelector('#parameters')") is None
    with page.leaving():
        page.run(
            "{ const kind = document.querySelector('#kind'); kind.value = 'correlate';"
            " kind.dispatchEvent(new Event('change')); }"
        )
    page.run("document.querySelector('#parameters').open = true")
    page.write("#name", "wider")
    page.write("#when", "0 3 * * *")
    page.write("#p-subset_radius_px", "12.5.1")
    page.click("#new button.main")
    page.wait_for("document.querySelector('#new .problem')?.textContent.includes('subset_radius_px')")
    page.complaints.clear()  # the browser notes the refusal
    page.run("document.querySelector('#p-subset_radius_px').value = ''")
    page.write("#p-subset_radius_px", "12")
    page.click("#new button.main")
    page.wait_for("document.querySelector('#schedules').textContent.includes('wider')")
    told = "fetch('/api/v1/schedules').then(a => a.json()).then(found => found.map(one => one.name))"
    assert "wider" in page.run(told)
    assert page.complaints == []


@pytest.mark.parametrize(
    ("kind", "parameter", "several"),
    [
        ("gauges", "gauge", "G1 x=0 y=0 length=20, G2 x=5 y=0 length=20"),
        ("export", "formats", "csv, vtk"),
        ("deviate", "translation_mm", "1, 2.5, 3"),
    ],
)
def test_several_values_of_a_parameter_are_written_as_at_a_command(
    page: Browser, site: str, kind: str, parameter: str, several: str
) -> None:
    page.visit(f"{site}/schedules?kind={kind}")
    page.run("document.querySelector('#parameters').open = true")
    page.write("#name", kind)
    page.write("#when", "0 3 * * *")
    page.write(f"#p-{parameter}", several)
    page.click("#new button.main")
    page.wait_for(f"document.querySelector('#schedules').textContent.includes('{kind} of plate')")
    assert page.complaints == []
