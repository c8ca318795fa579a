"""The page of recordings while a rig records: what comes in, what is planned, held back and let go on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from support.browser import Browser, browser_or_skip
from support.command import service
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.app.measuring import planned_recordings
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.virtual_rig.campaigns import small_plate

RIG = """
name = "bench"
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128 }]
projectors = [
    { name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 100.0 },
    { name = "P2", driver = "simulated", columns = 256, rows = 192, settle_ms = 100.0 },
]

[[channels]]
name = "load_n"
link = { port = "simulated" }
protocol = { terminator = "\\r", reply_terminator = "\\r\\n" }
request = "L?"
reply = '(?P<value>[-+]?\\d+(?:\\.\\d*)?)'
unit = "N"
"""
PLAN_OF = "document.querySelector('#planned').textContent"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with a campaign of two states, and its rig, which takes its time."""
    home = tmp_path_factory.mktemp("recordings") / "home"
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        calibration, campaign = small_plate("plate")
        register_campaign(
            services.catalogue,
            services.archive,
            replace(campaign, rig="bench", processing={"gauges": {"gauge": "g1 x=0 y=0 length=60"}}),
            replace(calibration, rig=replace(calibration.rig, name="bench")),
            datetime.now(UTC),
        )
        file = home / "rig.toml"
        file.write_text(RIG)
        services.stations.add(file, replace=False)
    return home


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Browser]:
    with Browser(browser_or_skip(), tmp_path) as browser:
        browser.screen(1280, 900)
        yield browser


def test_what_is_recorded_is_seen_and_a_plan_is_held_back_and_goes_on(page: Browser, home: Path) -> None:
    with serving(home) as site:
        page.visit(f"{site}/recordings?campaign=plate")
        page.run("window.here = true")
        assert "Nothing is planned" in page.run(PLAN_OF)
        page.run("document.querySelector('#plan-load').open = true")
        page.write("#tolerance", "500")
        page.click("#plan-load button.main")
        page.wait_for("document.querySelector('#plan-load .problem').textContent.includes('has no unit')")
        page.complaints.clear()  # the browser notes the refusal
        page.run("document.querySelector('#plan-next').open = true")
        # 60 mm are stretched by 0.5 %.
        page.write("#limits-next", "g1.extension_mm > 0.2mm")
        page.click("#plan-next button.main")
        page.wait_for(f"{PLAN_OF}.includes('plate/S00 is next')")
        assert "no worker serves" in page.run(PLAN_OF)
        page.click("#change-plate-S01")
        page.wait_for("document.querySelectorAll('#planned .state.asks').length === 1")
        page.screen(390, 900)
        assert page.run("document.documentElement.scrollWidth") <= 390
        page.screen(1280, 900)

        with service(home):
            page.wait_for("document.querySelector('#open .frame img')?.naturalWidth > 100", seconds=120)
            said = page.run("document.querySelector('#open .frame figcaption').textContent")
            assert "saturated" in said
            assert "load_n" in said
            page.wait_for("document.querySelector('#progress .frame img')?.naturalWidth > 100", seconds=180)
            assert "C1P" in page.run("document.querySelector('#progress .frame figcaption').textContent")
            page.wait_for(f"{PLAN_OF}.includes('plate/S01 is next: it is held back')", seconds=60)
            page.click("#go-plate")
            page.wait_for("document.querySelectorAll('#planned .state.good').length >= 2", seconds=180)
            page.wait_for(f"{PLAN_OF}.includes('is held after S01: g1.extension_mm is 0.')", seconds=180)
            looked = page.run("document.querySelector('#looks').textContent")
            assert "plate/S01/C1P1" in looked
            assert "g1 longer by 0." in looked
        assert page.run("window.here")
        assert page.complaints == []
    with bootstrap.services(home) as services:
        assert [one.status for one in planned_recordings.show(services, "plate")] == ["recorded", "recorded"]


def test_levels_are_planned_and_forgotten_in_the_page(page: Browser, home: Path) -> None:
    with serving(home) as site:
        page.visit(f"{site}/recordings?campaign=plate")
        page.run("document.querySelector('#plan-levels').open = true")
        page.write("#each", "10kN")
        page.write("#near", "6kN")
        page.click("#plan-levels button.main")
        page.wait_for("document.querySelector('#plan-levels .problem').textContent.includes('near both')")
        page.complaints.clear()  # the browser notes the refusal
        page.run("document.querySelector('#near').value = ''")
        page.write("#near", "200N")
        page.click("#plan-levels button.main")
        page.wait_for(f"{PLAN_OF}.includes('plate/S02 is next: waits for load_n = any multiple of 10000')")
        assert "plate/S02 to be added" in page.run(PLAN_OF)
        page.click("#drop-plate")
        page.click("#confirm button[value=yes]")
        page.wait_for(f"{PLAN_OF}.includes('Nothing is planned')")
        assert page.complaints == []
