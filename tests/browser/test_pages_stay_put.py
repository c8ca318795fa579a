"""What somebody does on a page stays while others change what it shows, and when it is come back to."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import SecretStr
from sqlalchemy import update
from support.browser import Browser, browser_or_skip
from support.homes import make_home
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.app.work import jobs, new_jobs, schedules
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.running.logs import job_log
from sms_jobs.records.job import JobState
from sms_jobs.records.people import Role

PASSWORD = "correct horse battery"
SIMULATE = Work("plate", ("simulate",))
REFUSING = """{ const ask = window.fetch; window.fetch = (address, options) => options?.method
    ? Promise.resolve(new Response(`{"error": "no, as ${address.split('/').at(-2)} says"}`, {status: 409}))
    : ask(address, options); }"""
"""Lets the page be refused all that it asks to be changed."""
WAITING = """{ const ask = window.fetch; window.asked = 0;
    const waiting = () => new Promise(done => { window.asked++;
        window.answer = () => done(new Response('{"error": "full"}', {status: 507})); });
    window.fetch = (address, options) => options?.method ? waiting() : ask(address, options); }"""
"""Lets the page wait for an answer, a refusal, until `answer` is called; counts what it asked for."""
NOTING = """{ const ask = window.fetch; window.fetch = async (address, options) => {
    const answer = await ask(address, options);
    if (answer.status === 401) window.refused = address;
    return answer; }; }"""
"""Lets the page say what it was refused last because nobody was known."""
SILENT = """{ const ask = window.fetch, wait = window.setTimeout; window.tried = [];
    window.setTimeout = (done, ms) => wait(done, ms / 100);
    window.speak = () => { window.fetch = ask; window.setTimeout = wait; };
    window.fetch = (address, {signal}) => new Promise((_, failed) => {
        window.tried.push(address); signal?.addEventListener('abort', () => failed(signal.reason)); }); }"""
"""Lets the page wait for a server that takes what it asks and says nothing, in a hundredth of the time."""


@pytest.fixture
def services(home: Path) -> Iterator[Services]:
    make_home(home, {})
    with bootstrap.services(home) as services:
        yield services


@pytest.fixture
def site(services: Services) -> Iterator[str]:
    with serving(services.settings.home) as address:
        yield address


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Browser]:
    with Browser(browser_or_skip(), tmp_path / "profile") as browser:
        browser.screen(1280, 900)
        yield browser


def watch(page: Browser, address: str) -> None:
    """Open a page that hears of changes by events alone, and know whether it is loaded again."""
    page.visit(address)
    # Nothing is fetched because time has passed.
    page.run("window.here = true; for (let k = setInterval(() => {}, 1e6); k > 0; k--) clearInterval(k)")


def enter(page: Browser) -> None:
    for kind in ("keyDown", "keyUp"):
        page.call(
            "Input.dispatchKeyEvent",
            type=kind,
            key="Enter",
            code="Enter",
            windowsVirtualKeyCode=13,
            text="\r" if kind == "keyDown" else "",
        )


def say(page: Browser, answer: str) -> None:
    page.wait_for("document.querySelector('dialog').open")
    page.click(f"dialog button[value={answer}]")


def go_and_come_back(page: Browser) -> None:
    """Follow the first link of a page, and press the button of the browser that leads back."""
    page.leave_by("header a.brand")
    with page.leaving():
        page.run("history.back()")


def test_what_was_typed_stays_beside_what_happens(page: Browser, site: str, services: Services) -> None:
    new_jobs.submit(services, Work("plate", ("simulate",), run="night"))
    watch(page, f"{site}/runs/night")
    page.write("#reason", "for the paper")
    page.run("document.activeElement.blur()")
    jobs.cancel(services, [], "plate")
    page.wait_for("document.querySelector('#run').textContent.includes('cancelled')")
    assert page.run("document.querySelector('#reason').value") == "for the paper"
    page.click("#keep")
    say(page, "yes")
    page.wait_for("document.querySelector('#run').textContent.includes(': for the paper')")
    assert page.run("window.here")
    assert page.complaints == []


def test_the_focus_stays_on_a_link_and_on_what_was_pressed(
    page: Browser, site: str, services: Services
) -> None:
    new_jobs.submit(services, SIMULATE)
    watch(page, f"{site}/jobs")
    page.run("document.querySelector('#jobs tr:last-child a').focus()")
    link = page.run("document.activeElement.pathname")
    page.run("window.scrollTo(0, 1e6)")
    jobs.cancel(services, [], "plate")
    page.wait_for("document.querySelector('#jobs').textContent.includes('cancelled')")
    assert page.run("document.activeElement.pathname") == link

    schedules.add(services, "nightly", "every 1h", SIMULATE)
    watch(page, f"{site}/schedules")
    page.run("document.querySelector('#hold-nightly').focus()")
    for word in ("Resume", "Pause"):
        enter(page)
        page.wait_for(f"document.querySelector('#hold-nightly').textContent === '{word}'")
        assert page.run("document.activeElement.id") == "hold-nightly"
    assert page.complaints == []


def test_what_follows_does_not_scroll_back_to_what_was_pressed(
    page: Browser, site: str, services: Services
) -> None:
    schedules.add(services, "nightly", "every 1h", SIMULATE)
    watch(page, f"{site}/schedules")
    page.run("document.querySelector('#hold-nightly').focus()")
    # Past the button, and not so far that a page ends before, of a month of four weeks and nothing to come.
    page.run("window.scrollTo(0, 300)")
    assert page.run("document.querySelector('#hold-nightly').getBoundingClientRect().bottom") < 0.0
    schedules.set_paused(services, "nightly", True)
    page.wait_for("document.querySelector('#hold-nightly').textContent === 'Resume'")
    assert page.run("document.activeElement.id") == "hold-nightly"
    assert page.run("window.scrollY") == 300


def test_a_log_and_a_wide_table_stay_where_they_are_read(
    page: Browser, site: str, services: Services
) -> None:
    (job, *_) = new_jobs.submit(services, SIMULATE).job_ids
    with services.catalogue.writing() as session:
        session.execute(update(JobRow).where(JobRow.id == job).values(state=JobState.RUNNING))
    log = job_log(services.settings.job_log_folder, job)
    log.parent.mkdir(parents=True, exist_ok=True)
    log.write_text("\n".join(f"line {k}" for k in range(300)))
    page.screen(390, 900)
    page.visit(f"{site}/jobs/{job}")
    where = (
        "[...document.querySelectorAll('pre.log, #story .wide')].map(one => [one.scrollTop, one.scrollLeft])"
    )
    page.run("document.querySelector('pre.log').focus(); document.querySelector('pre.log').scrollTop = 500")
    page.run("for (const one of document.querySelectorAll('#story .wide')) one.scrollLeft = 40")
    before = page.run(where)
    assert [500, 0] in before
    assert [0, 40] in before
    for more in ("first", "second"):
        with log.open("a") as file:
            file.write(f"\n{more}")
        page.wait_for(f"document.querySelector('pre.log').textContent.endsWith('{more}')")
        assert page.run(where) == before
        assert page.run("document.activeElement.className") == "log"
    # Whoever is at its end sees what is written.
    page.run("document.querySelector('pre.log').scrollTop = 1e6")
    with log.open("a") as file:
        file.write("\nmore" * 20)
    page.wait_for("document.querySelector('pre.log').textContent.endsWith('more')")
    assert (
        page.run(
            "(one => one.scrollHeight - one.clientHeight - one.scrollTop)(document.querySelector('pre.log'))"
        )
        < 2
    )


@pytest.mark.parametrize("answer", ["no", "yes"])
def test_what_happened_during_a_question_is_seen_after_it(
    page: Browser, site: str, services: Services, answer: str
) -> None:
    schedules.add(services, "nightly", "every 1h", SIMULATE)
    watch(page, f"{site}/schedules")
    page.click("#remove-nightly")
    page.wait_for("document.querySelector('dialog').open")
    schedules.remove(services, "nightly")  # in another window
    # It has heard of it, and asked for the page.
    page.wait_for("performance.getEntriesByType('resource').some(e => e.name.endsWith('/schedules'))")
    say(page, answer)
    page.wait_for("document.querySelector('#remove-nightly') === null", seconds=5)
    told = page.run("document.querySelector('#schedules > .problem')?.textContent ?? ''")
    assert ("no schedule" in told) == (answer == "yes")


def test_refusals_whose_buttons_are_gone_keep_their_order(
    page: Browser, site: str, services: Services
) -> None:
    names = ("first", "second", "third")
    for name in names:
        schedules.add(services, name, "every 1h", SIMULATE)
    watch(page, f"{site}/schedules")
    page.run(REFUSING)
    for name in names:
        page.click(f"#hold-{name}")
        page.wait_for(f"document.querySelector('#schedules').textContent.includes('no, as {name} says.')")
    said = "[...document.querySelectorAll('#schedules > .problem')].map(one => one.textContent)"
    expected = [f"no, as {name} says." for name in names[:2]]
    schedules.remove(services, "first")
    page.wait_for(f"{said}.length === 1")
    schedules.remove(services, "second")
    page.wait_for(f"{said}.length === 2")
    for paused in (True, False):
        schedules.set_paused(services, "third", paused)
        page.wait_for(
            f"document.querySelector('#hold-third').textContent === '{'Resume' if paused else 'Pause'}'"
        )
        assert sorted(page.run(said)) == expected
        first = page.run(said)
    schedules.set_paused(services, "third", True)
    page.wait_for("document.querySelector('#hold-third').textContent === 'Resume'")
    assert page.run(said) == first
    assert "third" in page.run("document.querySelector('#hold-third').form.textContent")


def test_nothing_else_is_asked_of_a_form_while_it_waits_and_what_it_said_is_over(
    page: Browser, site: str, services: Services
) -> None:
    watch(page, f"{site}/campaigns/plate?kind=simulate")
    page.click("#estimate")
    page.wait_for("document.querySelector('#submit .outcome').textContent.includes('Would submit 2')")
    page.run(WAITING)
    page.click("#estimate")
    page.wait_for("window.asked === 1")
    assert page.run("document.querySelector('#submit .outcome').textContent") == ""
    page.click("#go")
    page.run("document.querySelector('#which').open = true")
    page.run("document.querySelector('#run').focus()")
    enter(page)
    assert page.run("window.asked") == 1
    page.run("window.answer()")
    page.wait_for("document.querySelector('#submit .problem').textContent === 'full.'")
    page.click("#go")
    page.wait_for("window.asked === 2")


def test_the_browser_that_goes_back_shows_what_would_be_done(
    page: Browser, site: str, services: Services
) -> None:
    kinds = "document.querySelector('[name=kinds]').value"
    chosen = "document.querySelector('#kind').selectedOptions[0].value"
    for path in ("campaigns/plate", "schedules"):
        page.visit(f"{site}/{path}")
        with page.leaving():
            page.run(
                "{ const kind = document.querySelector('#kind'); kind.value = 'simulate';"
                " kind.dispatchEvent(new Event('change')); }"
            )
        assert (page.run(chosen), page.run(kinds)) == ("simulate", "simulate")
        with page.leaving():
            page.run("history.back()")
        page.wait_for(f"{chosen} === {kinds}", seconds=3)
        assert page.run(kinds) == "pipeline"
    page.run(
        "{ const form = document.querySelector('#form'); form.value = 'every';"
        " form.dispatchEvent(new Event('change', {bubbles: true})); }"
    )
    go_and_come_back(page)
    page.wait_for("document.querySelector('#when').name === document.querySelector('#form').value", seconds=3)


def test_what_the_browser_kept_of_a_form_is_not_folded_away(
    page: Browser, site: str, services: Services
) -> None:
    page.visit(f"{site}/campaigns/plate?kind=correlate")
    for part in ("which", "parameters"):
        page.run(f"document.querySelector('#{part}').open = true")
    page.click("input[name=states][value=S01]")
    page.write("#p-subset_radius_px", "12")
    go_and_come_back(page)
    assert page.run("document.querySelector('input[name=states][value=S01]').checked")
    page.wait_for(
        "document.querySelector('#which').open && document.querySelector('#parameters').open", seconds=3
    )
    page.visit(f"{site}/campaigns/plate?kind=correlate")
    assert page.run("document.querySelectorAll('details[open]').length") == 0


def test_a_page_hears_of_changes_again_after_its_session_was_begun_anew(
    page: Browser, site: str, services: Services
) -> None:
    people.add(services, "ada", Role.ADMINISTRATOR, SecretStr(PASSWORD))
    schedules.add(services, "nightly", "every 1h", SIMULATE)
    page.visit(f"{site}/schedules")
    page.write("#name", "ada")
    page.write("#password", PASSWORD)
    page.leave_by("button.main")
    watch(page, f"{site}/schedules")
    page.write("#name", "weekly")
    page.run(NOTING)
    for session in people.list_access(services, "ada"):
        people.revoke(services, session.id)
    page.run("document.querySelector('#hold-nightly').click()")
    page.wait_for("document.querySelector('#connection').textContent.includes('Your session has ended')")
    # As when it is behind the window in which somebody will log in, and looked at before that.
    for hidden in ("true", "false"):
        page.run(f"Object.defineProperty(document, 'hidden', {{value: {hidden}, configurable: true}})")
        page.run("document.dispatchEvent(new Event('visibilitychange'))")
    page.wait_for("window.refused === '/api/v1/events'")
    again = json.dumps({"name": "ada", "password": PASSWORD})
    asked = f"fetch('/api/v1/session', {{method: 'POST', body: {json.dumps(again)}, "
    assert page.run(asked + "headers: {'Content-Type': 'application/json'}}).then(a => a.status)") < 300
    page.wait_for("document.querySelector('#connection').hidden", seconds=30)
    schedules.set_paused(services, "nightly", True)
    page.wait_for("document.querySelector('#hold-nightly').textContent === 'Resume'", seconds=20)
    assert page.run("document.querySelector('#name').value") == "weekly"
    assert page.run("window.here")


def test_a_page_says_who_has_logged_in_elsewhere_and_that_it_may_not_be_seen_any_more(
    page: Browser, site: str, services: Services
) -> None:
    for name in ("ada", "bob"):
        people.add(services, name, Role.ADMINISTRATOR, SecretStr(PASSWORD))
    page.visit(f"{site}/people")
    page.write("#name", "ada")
    page.write("#password", PASSWORD)
    page.leave_by("button.main")
    watch(page, f"{site}/people")
    assert page.run("document.querySelector('.who a').textContent") == "ada administrator"
    other = json.dumps({"name": "bob", "password": PASSWORD})
    asked = f"fetch('/api/v1/session', {{method: 'POST', body: {json.dumps(other)}, "
    assert page.run(asked + "headers: {'Content-Type': 'application/json'}}).then(a => a.status)") < 300
    schedules.add(services, "nightly", "every 1h", SIMULATE)
    page.wait_for("document.querySelector('.who a').textContent === 'bob administrator'")
    people.set_role(services, "bob", Role.VIEWER)
    schedules.set_paused(services, "nightly", True)
    page.wait_for("document.querySelector('#connection').textContent.startsWith('You may no longer see')")
    assert page.run("window.here")


def test_a_server_that_takes_requests_and_says_nothing_is_away(
    page: Browser, site: str, services: Services
) -> None:
    schedules.add(services, "nightly", "every 1h", SIMULATE)
    page.visit(f"{site}/schedules")
    page.run(SILENT)
    # As when it is left and looked at again, which begins another connection.
    for hidden in ("true", "false"):
        page.run(f"Object.defineProperty(document, 'hidden', {{value: {hidden}, configurable: true}})")
        page.run("document.dispatchEvent(new Event('visibilitychange'))")
    page.wait_for(
        "document.querySelector('#connection').textContent.startsWith('The server does not answer')"
    )
    page.wait_for("window.tried.filter(one => one.endsWith('/events')).length > 2")
    page.run("window.speak()")
    page.wait_for("document.querySelector('#connection').hidden", seconds=60)
    schedules.set_paused(services, "nightly", True)
    page.wait_for("document.querySelector('#hold-nightly').textContent === 'Resume'")
