"""Named runs in a browser: begun from a campaign, shown, compared, kept and forgotten."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from pydantic import SecretStr
from support.browser import Browser, browser_or_skip
from support.command import service
from support.homes import make_home
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.app.work import jobs, new_jobs, waiting
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.records.people import Role

PASSWORD = "correct horse battery"
KINDS = ("simulate", "reconstruct", "correlate")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The console of a home with two runs, the later one with wider subsets, and two people."""
    home = tmp_path_factory.mktemp("runs") / "home"
    make_home(home, {})
    with bootstrap.services(home) as services:
        people.add(services, "ada", Role.ADMINISTRATOR, SecretStr(PASSWORD))
        people.add(services, "vera", Role.VIEWER, SecretStr(PASSWORD))
        with service(home):
            for name, parameters in (("first", {}), ("wider", {"correlate.subset_radius_px": 12})):
                new_jobs.submit(services, Work("plate", KINDS, parameters, views=("C1P1",), run=name))
                waited = waiting.wait_for(services, jobs.choose(services, [], "plate"))
                assert waited.failures == 0
    with serving(home) as address:
        yield address


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Browser]:
    with Browser(browser_or_skip(), tmp_path) as browser:
        browser.screen(1280, 900)
        yield browser


def log_in(page: Browser, site: str, name: str, path: str) -> None:
    page.visit(site + path)
    page.write("#name", name)
    page.write("#password", PASSWORD)
    page.leave_by("button.main")


def asked(page: Browser, address: str) -> Any:
    return json.loads(page.run(f"fetch('/api/v1/{address}').then(a => a.text())"))


def test_two_runs_are_compared_one_is_kept_and_a_name_forgotten(page: Browser, site: str) -> None:
    log_in(page, site, "ada", "/runs")
    assert page.run("[...document.querySelectorAll('#runs tbody th')].map(e => e.textContent)") == [
        "wider",
        "first",
    ]
    page.visit(f"{site}/runs/first")
    results = page.run("document.querySelector('#results').textContent")
    assert "correlate" in results
    with page.leaving():
        page.click("#compare")
    assert page.run("location.pathname + location.search") == "/runs/first/compare?with=wider"
    changes = page.run("document.querySelector('#changes tbody').textContent")
    assert "correlate.subset_radius_px" in changes
    told = asked(page, "runs/first/compare?with=wider")
    shown = page.run("document.querySelectorAll('#differences tbody tr').length")
    assert shown == len(told["differences"]) > 0
    first = page.run("document.querySelector('#differences tbody tr').textContent")
    assert told["differences"][0]["subject"] in first
    assert f"{told['differences'][0]['points']:,}" in first
    for width in (1280, 390):
        page.screen(width, 900)
        assert page.run("document.documentElement.scrollWidth") <= width
    kept = page.run("fetch(document.querySelector('#page').href).then(a => a.text())")
    assert "Changes as C1P1 sees them" in kept

    page.screen(1280, 900)
    page.visit(f"{site}/runs/first")
    page.write("#reason", "figure 4")
    page.click("#keep")
    page.wait_for("document.querySelector('dialog').open")
    page.click("dialog button[value=yes]")
    page.wait_for("document.querySelector('#run').textContent.includes('figure 4')")
    assert page.run("document.querySelector('#keep')") is None
    page.visit(f"{site}/runs/wider")
    page.click("#drop")
    page.wait_for("document.querySelector('dialog').open")
    with page.leaving():
        page.click("dialog button[value=yes]")
    assert page.run("location.pathname") == "/runs"
    assert [(one["name"], one["reason"]) for one in asked(page, "runs")] == [("first", "figure 4")]
    assert page.complaints == []
    page.visit(f"{site}/runs/wider")
    assert "here is no run 'wider'" in page.run("document.querySelector('main').textContent")


def test_a_viewer_sees_runs_and_may_change_none(page: Browser, site: str) -> None:
    log_in(page, site, "vera", "/runs/first")
    assert page.run("location.pathname") == "/runs/first"
    assert page.run("document.querySelectorAll('[data-action]').length") == 0
    assert httpx2.delete(f"{site}/api/v1/runs/first").status_code == 401
    asked = "fetch('/api/v1/runs/first', {method: 'DELETE'}).then(a => a.status)"
    assert page.run(asked) == 403
