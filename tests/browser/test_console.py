"""The console as people use it: in a real browser, against the real service."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import httpx2
import psutil
import pytest
from pydantic import SecretStr
from support.browser import Browser, browser_or_skip
from support.calibration_sessions import SessionInMemory
from support.command import SMS, kill_all, service
from support.homes import make_home, stored
from support.serving import free_port, serving
from support.sessions import small_session

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.people import Role
from sms_jobs.web.console import PAGE_RULES, subjects

PASSWORD = "correct horse battery"
TARGET_PX = 44
assert subjects()  # whose pages are walked below


def at_home(home: Path) -> Path:
    """Make a home with the small plate, a session that has given a calibration, and two people."""
    make_home(home, {})
    session = SessionInMemory.observed(small_session("session"))
    session.calibrate_boards()
    records = dict(session.calibrate())
    with bootstrap.services(home) as services:
        register_campaign(services.catalogue, services.archive, session.campaign, None, datetime.now(UTC))
        stored(services, "calibrate", "session", records)
        people.add(services, "ada", Role.ADMINISTRATOR, SecretStr(PASSWORD))
        people.add(services, "vera", Role.VIEWER, SecretStr(PASSWORD))
    return home


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home for all tests of this file."""
    return at_home(tmp_path_factory.mktemp("console") / "home")


@pytest.fixture(scope="module")
def site(home: Path) -> Iterator[str]:
    """The address of the console."""
    with serving(home) as address:
        yield address


@pytest.fixture(scope="module")
def started(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A browser for all tests of this file."""
    with Browser(browser_or_skip(), tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture
def page(started: Browser) -> Iterator[Browser]:
    """The browser, as new."""
    started.screen(1280, 900)
    started.call("Network.clearBrowserCookies")
    yield started
    started.visit("about:blank")


def log_in(page: Browser, site: str, name: str, path: str = "/") -> None:
    page.visit(site + path)
    page.write("#name", name)
    page.write("#password", PASSWORD)
    page.leave_by("button.main")
    assert page.run("location.pathname") == path.partition("?")[0]


def press(page: Browser, key: str, number: int, text: str = "") -> None:
    for kind in ("keyDown", "keyUp"):
        page.call(
            "Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=number, text=text
        )
        text = ""


def test_a_campaign_is_computed_looked_at_compared_and_a_calibration_certified(
    page: Browser, site: str, home: Path
) -> None:
    log_in(page, site, "ada", "/campaigns/plate")
    with service(home):
        page.visit(f"{site}/campaigns/plate?kind=simulate")
        page.run("window.here = true")  # gone once the page is loaded again
        page.click("#go")
        page.wait_for("document.querySelector('#submit .outcome').textContent.includes('Submitted 2 jobs')")
        page.wait_for("document.querySelectorAll('#matrix .state.good').length === 4", seconds=120)
        assert page.run("window.here")

        page.visit(f"{site}/campaigns/plate")
        page.run("window.here = true")
        page.click("#estimate")
        page.wait_for("document.querySelector('#submit .outcome').textContent.includes('Would submit 15')")
        page.click("#go")
        page.wait_for("document.querySelector('#submit .outcome').textContent.includes('Submitted 15')")
        for done in ("#tuples-S00-C1P1-reconstruct", "#tuples-S01-C1P2-strain", "#wholes---report"):
            page.wait_for(f"document.querySelector('{done} .good')", seconds=120)
        assert page.run("window.here")

        page.visit(f"{site}/campaigns/plate?kind=strain")
        page.click("#parameters summary")
        page.write("#p-gauge_length_mm", "12.5")
        page.click("#go")
        page.wait_for("document.querySelector('#submit .outcome').textContent.includes('Submitted 2')")
        page.wait_for("document.querySelector('#state').textContent.includes('19 succeeded')", seconds=120)

    page.visit(f"{site}/campaigns/plate")
    page.leave_by("#tuples-S01-C1P2-strain")
    page.wait_for("document.querySelector('#picture').naturalWidth > 100")
    assert page.run("document.querySelectorAll('.lineage a').length") == 7
    page.leave_by("a[href^='/field/']")
    page.wait_for("document.querySelector('#m0 .readout')?.textContent.length > 9")
    page.write("#gauge-text", "G1 x=0 y=0 length=20")
    page.click("#gauge button")
    page.wait_for("document.querySelector('#told').textContent.includes('pixels of C1P2')")
    again = "#with optgroup[label^='The same'] option"
    assert page.run(f"document.querySelector(`{again}`).textContent").startswith("gauge length mm ")
    page.run(f"document.querySelector(`{again}`).selected = true")
    page.leave_by("form[method=get] button")
    page.wait_for("document.querySelector('#difference .readout')?.textContent.length > 9")
    chosen = page.run("document.querySelector('#with').selectedOptions[0].textContent")
    assert chosen.startswith("gauge length mm")

    page.visit(f"{site}/certify/session")
    page.write("#reason", "held out poses of the bar agree")
    page.write("#password", "wrong password")
    page.click("form#certify .main")
    page.wait_for("document.querySelector('#certify .problem').textContent.includes('not right')")
    assert page.run("document.querySelector('#reason').value") == "held out poses of the bar agree"
    page.run("document.querySelector('#password').value = ''")
    page.write("#password", PASSWORD)
    page.complaints.clear()  # the browser notes the refusal
    page.leave_by("form#certify .main")
    assert page.run("location.pathname") == "/calibrations"
    assert "its rig" in page.run("document.querySelector('#calibrations').textContent")
    page.visit(f"{site}/audit?action=calibrations.certify")
    assert "held out poses of the bar agree" in page.run("document.querySelector('#links').textContent")
    page.visit(f"{site}/audit?limit=4")
    numbers = "[...document.querySelectorAll('#links tbody th')].map(one => Number(one.textContent))"
    four = page.run(numbers)
    page.visit(f"{site}/audit?limit=2")
    page.leave_by("a.button[href*='after=']")
    assert page.run(numbers) == four[2:]
    page.leave_by("a.button:not([href*='after='])")
    assert page.run(numbers)[:4] == four
    assert page.complaints == []

    page.leave_by(".who form button")
    assert page.run("location.pathname") == "/login"
    page.visit(f"{site}/audit")
    assert page.run("location.pathname") == "/login"


def test_a_viewer_is_offered_no_change_and_refused_each(page: Browser, site: str) -> None:
    log_in(page, site, "vera", "/campaigns/plate")
    for path in ("/", "/campaigns", "/campaigns/plate", "/calibrations/1", "/schedules", "/recordings"):
        page.visit(site + path)
        assert page.run("document.querySelectorAll('[data-action]').length") == 0, path
    for address, body in (
        ("jobs", {"campaign": "plate", "kinds": ["pipeline"]}),
        ("jobs/cancel", {"campaign": "plate"}),
        ("queues/pause", {"names": ["cpu"]}),
        ("calibrations/certify", {"session": "session", "password": PASSWORD}),
        ("people", {"name": "eve", "role": "administrator"}),
    ):
        asked = f"fetch('/api/v1/{address}', {{method: 'POST', body: {json.dumps(json.dumps(body))}, "
        asked += "headers: {'Content-Type': 'application/json'}}).then(a => a.status)"
        assert page.run(asked) == 403, address


def test_every_page_fits_and_nothing_is_complained_of(page: Browser, site: str) -> None:
    log_in(page, site, "ada")
    paths = [path for path in PAGE_RULES if "{" not in path]
    for path in [*paths, "/campaigns/plate", "/calibrations/1", "/archive/1", "/people/vera"]:
        for width, themes in ((1280, ("light", "dark")), (390, ("dark", "light"))):
            page.screen(width, 900)
            show_theme(page, themes[0])
            page.visit(site + path)
            page.wait_for("document.readyState === 'complete'")
            assert_fits(page, path, width)
            show_theme(page, themes[1])
            assert_fits(page, path, width)
    page.call("Emulation.setEmulatedMedia", features=[])


def show_theme(page: Browser, theme: str) -> None:
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": theme}])


def assert_fits(page: Browser, path: str, width: int) -> None:
    assert page.complaints == [], path
    assert page.run("document.documentElement.scrollWidth") <= width, (path, width)
    small = page.run(
        "[...document.querySelectorAll('button, select, header a, .button, input')]"
        ".filter(e => e.offsetParent && !e.closest('label.check') && !e.matches('.brand'))"
        f".filter(e => e.getBoundingClientRect().height < {TARGET_PX - 1})"
        ".map(e => e.outerHTML.slice(0, 80))"
    )
    assert small == [], path


def test_the_theme_is_switched_and_kept(page: Browser, site: str) -> None:
    log_in(page, site, "vera")
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "light"}])
    colour = "getComputedStyle(document.body).backgroundColor"
    before = page.run(colour)
    page.click("#theme")
    dark = page.run(colour)
    assert dark != before
    page.visit(f"{site}/jobs")
    assert page.run(colour) == dark
    page.run("localStorage.clear()")


def test_it_is_used_without_a_mouse(page: Browser, site: str) -> None:
    log_in(page, site, "ada")
    press(page, "Tab", 9)
    assert page.run("document.activeElement.textContent") == "Skip to the content"
    assert page.run("document.activeElement.getBoundingClientRect().x") >= 0
    press(page, "Enter", 13, "\r")
    page.wait_for("document.activeElement.id === 'content'")
    page.visit(site)
    for _ in range(20):
        press(page, "Tab", 9)
        if page.run("document.activeElement.textContent") == "Campaigns":
            break
    assert page.run("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    with page.leaving():
        press(page, "Enter", 13, "\r")
    assert page.run("location.pathname") == "/campaigns"
    page.visit(site)
    page.run("document.querySelector('#pause-io').focus()")
    press(page, "Enter", 13, "\r")
    page.wait_for("document.querySelector('dialog').open")
    assert page.run("document.activeElement.value") == "no"
    press(page, "Tab", 9)
    press(page, "Enter", 13, "\r")
    page.wait_for("document.querySelector('#resume-io')")
    page.click("#resume-io")
    page.wait_for("document.querySelector('#pause-io')")
    assert page.complaints == []


def test_a_page_says_that_the_server_is_away_and_goes_on_by_itself(page: Browser, home: Path) -> None:
    port = free_port()
    with serving(home, port=port) as site:
        log_in(page, site, "ada")
        page.run("window.here = true")
    page.wait_for("!document.querySelector('#connection').hidden", seconds=60)
    assert "Trying again by itself" in page.run("document.querySelector('#connection').textContent")
    with serving(home, port=port):
        page.wait_for("document.querySelector('#connection').hidden", seconds=60)
        assert page.run("window.here")
        with page.leaving(), bootstrap.services(home) as services:
            for session in people.list_access(services, "ada"):
                people.revoke(services, session.id)
        assert page.run("location.pathname") == "/login"
        assert page.run("new URLSearchParams(location.search).get('next')") == "/"


def test_a_password_that_is_set_is_told(page: Browser, site: str) -> None:
    log_in(page, site, "ada", "/people/vera")
    page.write("#password", PASSWORD)
    page.click("#word button")
    page.wait_for("document.querySelector('#said').textContent.startsWith('The password is set')")
    assert page.run("document.querySelector('#password').value") == ""
    assert page.complaints == []


def test_what_is_typed_outlives_the_session(page: Browser, site: str, home: Path) -> None:
    log_in(page, site, "ada", "/campaigns/plate?kind=simulate")
    page.run("document.querySelector('#run').value = 'night'")  # it is folded away
    with bootstrap.services(home) as services:
        for session in people.list_access(services, "ada"):
            people.revoke(services, session.id)
    page.click("#estimate")
    page.wait_for("document.querySelector('#connection').textContent.includes('Your session has ended')")
    assert page.run("document.querySelector('#run').value") == "night"
    again = json.dumps({"name": "ada", "password": PASSWORD})
    asked = f"fetch('/api/v1/session', {{method: 'POST', body: {json.dumps(again)}, "
    assert page.run(asked + "headers: {'Content-Type': 'application/json'}}).then(a => a.status)") < 300
    page.click("#estimate")
    page.wait_for("document.querySelector('#submit .outcome').textContent.includes('Would submit 2')")
    page.wait_for("document.querySelector('#connection').hidden", seconds=60)


def test_the_console_ends_with_the_service_and_begins_again_when_it_dies(home: Path) -> None:
    port = free_port()
    up = psutil.Popen([*SMS, "up", "--web", "--listen", f"127.0.0.1:{port}", "--home", str(home)])
    try:
        first = _console(up, port)
        first.kill()
        second = _console(up, port, other_than=first.pid)
        up.kill()
        second.wait(30)
    finally:
        if up.poll() is None:
            kill_all(up)
        up.wait()


def _console(up: psutil.Popen, port: int, other_than: int = 0) -> psutil.Process:
    """Return the process that serves, once it answers."""
    until = time.monotonic() + 60
    while time.monotonic() < until:
        try:
            found = [p for p in up.children() if p.pid != other_than and "serve" in p.cmdline()]
            if found and httpx2.get(f"http://127.0.0.1:{port}/login").status_code == 200:
                return found[0]
        except (httpx2.TransportError, psutil.Error):
            pass
        time.sleep(0.2)
    raise AssertionError("the console does not answer")
