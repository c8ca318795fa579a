"""Pages of the console: what they show, to whom, and how they refuse."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import httpx2
import pytest
from pydantic import SecretStr
from support.homes import make_home
from support.over_http import app_of, served

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.app.specimens import campaigns
from sms_jobs.app.work import new_jobs, schedules
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.records.people import RIGHTS, Role
from sms_jobs.web.console import PAGE_RULES, subjects

PASSWORD = "correct horse battery"
assert subjects()  # whose rules are tried below


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with the small plate, whose pipeline waits."""
    home = tmp_path_factory.mktemp("console") / "home"
    make_home(home, {})
    with bootstrap.services(home) as services:
        new_jobs.submit(services, Work("plate", ("simulate", "pipeline")))
    return home


@pytest.fixture(scope="module")
def desk(home: Path) -> Iterator[httpx2.Client]:
    """Whoever sits at the machine, before anybody has a name."""
    with bootstrap.services(home, "web") as services, served(app_of(services)) as client:
        client.base_url = httpx2.URL(str(client.base_url).removesuffix("/api/v1/"))
        yield client


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx2.Client]:
    """A browser at a home with a person of each role."""
    home = tmp_path_factory.mktemp("named") / "home"
    make_home(home, {})
    with bootstrap.services(home, "web") as services, served(app_of(services)) as client:
        for role in (Role.ADMINISTRATOR, *(r for r in Role if r is not Role.ADMINISTRATOR)):
            people.add(services, role.value, role, SecretStr(PASSWORD))
        client.base_url = httpx2.URL(str(client.base_url).removesuffix("/api/v1/"))
        yield client


def log_in(client: httpx2.Client, name: str, password: str = PASSWORD, back: str = "/") -> httpx2.Response:
    client.cookies.clear()
    return client.post("/login", data={"name": name, "password": password, "next": back})


@pytest.mark.parametrize("path", sorted(p for p in PAGE_RULES if "{" not in p))
def test_every_page_is_shown_with_one_heading_and_what_it_is_called(desk: httpx2.Client, path: str) -> None:
    page = desk.get(path)
    assert page.status_code == 200, page.text
    assert len(re.findall("<h1>", page.text)) == 1
    assert "<style" not in page.text
    assert not re.search(r"<script(?![^>]* src=)|\son\w+=|\sstyle=", page.text)
    named = set(re.findall(r'<label for="([^"]+)"', page.text))
    assert named <= set(re.findall(r'\sid="([^"]+)"', page.text))


def test_a_campaign_shows_each_state_and_view_with_the_job_that_is_in_the_way(desk: httpx2.Client) -> None:
    page = desk.get("/campaigns/plate").text
    assert page.count('id="tuples-S01-C1P2-') == 4  # reconstruct, assess, correlate, strain
    assert "waiting" in page
    assert 'name="parameters:' not in page
    chosen = desk.get("/campaigns/plate", params={"kind": "correlate"}).text
    assert 'name="parameters:subset_radius_px"' in chosen
    assert "<option>gauss-newton</option>" in chosen


@pytest.mark.parametrize(("shown", "more"), [(200, 800), (3200, 10_000), (10_000, None)])
def test_more_campaigns_are_offered_as_far_as_a_page_goes(
    desk: httpx2.Client, monkeypatch: pytest.MonkeyPatch, shown: int, more: int | None
) -> None:
    def many(services: bootstrap.Services, limit: int) -> campaigns.Campaigns:
        return replace(found(services, 1), newest=shown * found(services, 1).newest, total=20_000)

    found = campaigns.list_campaigns
    monkeypatch.setattr(campaigns, "list_campaigns", many)
    page = desk.get("/campaigns").text
    offered = re.findall(r'href="(/campaigns\?limit=(\d+))"', page)
    assert [int(limit) for _, limit in offered] == ([] if more is None else [more])
    assert all(desk.get(address).status_code == 200 for address, _ in offered)


def test_jobs_are_listed_page_by_page(desk: httpx2.Client) -> None:
    seen: list[str] = []
    after = ""
    while True:
        page = desk.get("/jobs", params={"limit": 5, "after": after}).text
        found = re.findall(r'href="/jobs/([0-9a-f]{16})"', page)
        seen += found
        if "Older ones" not in page:
            break
        after = found[-1]
    assert len(seen) == len(set(seen)) == 17


def test_what_is_typed_stays_beside_what_is_wrong_with_it(desk: httpx2.Client) -> None:
    page = desk.get("/archive", params={"query": 'strain "<b>'})
    assert page.status_code == 200
    assert "strain &#34;&lt;b&gt;" in page.text
    assert 'class="problem" id="query-problem" role="alert">Th' in page.text
    assert "<b>" not in page.text


@pytest.mark.parametrize(
    ("path", "status", "words"),
    [
        ("/jobs/none", 404, "no job"),
        ("/campaigns/none", 404, "no campaign"),
        ("/nowhere", 404, "no page /nowhere"),
        ("/jobs?limit=x", 422, "cannot be used"),
        ("/schedules?day=0001-01-01", 422, "0001-01&#39; is no month from 2000 to 2199"),
    ],
)
def test_an_error_of_a_page_is_a_page(desk: httpx2.Client, path: str, status: int, words: str) -> None:
    page = desk.get(path)
    assert (page.status_code, words in page.text, "<h1>" in page.text) == (status, True, True)
    assert desk.get("/api/v1/jobs/none").json()["kind"] == "NotFound"


def test_a_choice_without_effect_is_refused_over_http_as_well(desk: httpx2.Client) -> None:
    order = {"kinds": ["merge"], "campaign": "plate", "views": ["C1P1"]}
    for path, more in (("/api/v1/jobs", {}), ("/api/v1/schedules", {"name": "n", "every": "1h"})):
        refused = desk.post(path, json=order | more)
        assert refused.status_code == 422
        assert "by `view` has no effect on it: submit merge without it" in refused.text


def test_who_records_no_state_is_told_to_choose_one(desk: httpx2.Client) -> None:
    before = desk.get("/api/v1/jobs").json()
    refused = desk.post("/api/v1/recordings", json={"campaign": "plate", "states": []})
    assert refused.status_code == 422
    said = "no state of plate is chosen: choose at least one that is to be recorded"
    assert refused.json()["error"] == said
    assert desk.get("/api/v1/jobs").json() == before


def test_whoever_is_not_known_is_led_to_the_door_and_back(named: httpx2.Client) -> None:
    named.cookies.clear()
    away = named.get("/jobs?kind=strain")
    assert (away.status_code, away.headers["Location"]) == (303, "/login?next=%2Fjobs%3Fkind%3Dstrain")
    assert 'value="/jobs?kind=strain"' in named.get(away.headers["Location"]).text
    wrong = log_in(named, "viewer", "wrong", "/jobs")
    assert (wrong.status_code, 'value="viewer"' in wrong.text) == (403, True)
    assert "The name or the password is not right" in wrong.text
    right = log_in(named, "viewer", back="/jobs?kind=strain")
    assert (right.status_code, right.headers["Location"]) == (303, "/jobs?kind=strain")
    assert {"HttpOnly", "SameSite=strict"} <= set(right.headers["Set-Cookie"].split("; "))
    assert named.get("/jobs").status_code == 200
    assert named.post("/logout", headers={"Sec-Fetch-Site": "same-origin"}).status_code == 303
    assert named.get("/jobs").status_code == 303


@pytest.mark.parametrize(
    "back", ["//evil.example", "https://evil.example/", "/\\evil.example", "/login?x", "//["]
)
def test_the_way_back_never_leads_elsewhere(named: httpx2.Client, back: str) -> None:
    assert 'name="next" value="/"' in named.get("/login", params={"next": back}).text
    assert log_in(named, "viewer", back=back).headers["Location"] == "/"


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_another_site_can_neither_log_in_nor_out(named: httpx2.Client, site: str) -> None:
    body = {"name": "viewer", "password": PASSWORD}
    for path in ("/login", "/logout"):
        answer = named.post(path, data=body, headers={"Sec-Fetch-Site": site})
        assert (answer.status_code, "Set-Cookie" in answer.headers) == (403, False)


@pytest.mark.parametrize("own", [True, False], ids=["of the attacker", "made up"])
def test_a_session_that_was_planted_never_becomes_that_of_who_logs_in(
    named: httpx2.Client, own: bool
) -> None:
    log_in(named, "viewer")
    planted = named.cookies["sms_session"] if own else "sms_" + "A" * 43
    named.cookies.clear()
    named.cookies.set("sms_session", planted, domain=named.base_url.host, path="/")
    body = {"name": "administrator", "password": PASSWORD}
    begun = named.post("/login", data=body, headers={"Sec-Fetch-Site": "same-origin"}).headers["Set-Cookie"]
    given = begun.partition("=")[2].partition(";")[0]
    assert given != planted
    for cookie, status in ((given, 200), (planted, 403 if own else 303)):
        named.cookies.clear()
        named.cookies.set("sms_session", cookie, domain=named.base_url.host, path="/")
        assert named.get("/people").status_code == status, cookie


@pytest.mark.parametrize("role", Role)
def test_what_a_role_may_not_do_is_neither_offered_nor_done(named: httpx2.Client, role: Role) -> None:
    log_in(named, role.value)
    rights = RIGHTS[role]
    for path, rule in PAGE_RULES.items():
        answer = named.get(path.replace("{name}", "plate").replace("{number}", "1"))
        refused = rule.right is not None and rule.right not in rights
        assert (answer.status_code == 403) == refused, path
    campaign, start = named.get("/campaigns/plate").text, named.get("/").text
    offered = {
        "compute": 'data-action="/api/v1/jobs"' in campaign,
        "record": 'data-action="/api/v1/queues/pause"' in start,
        "certify": '/calibrations/1/use"' in named.get("/calibrations/1").text,
        "administer": 'href="/people"' in start,
    }
    names = {right.value for right in rights}
    assert offered == {right: right in names for right in offered}


def test_a_schedule_of_what_meets_a_question_leads_to_no_campaign_of_that_name(
    desk: httpx2.Client, home: Path
) -> None:
    with bootstrap.services(home) as services:
        schedules.add(services, "named", "every 1h", Work("plate", ("simulate",)))
        schedules.add(services, "asked", "every 1h", Work("", ("simulate",)), where="load_n >= 0")
    page = desk.get("/schedules").text
    assert 'of <a href="/campaigns/plate">plate</a>' in page
    assert "<td>simulate where load_n &gt;= 0</td>" in page
    assert 'href="/campaigns/where' not in page


def test_the_calendar_is_told_to_programs(desk: httpx2.Client, home: Path) -> None:
    at = {"month": "2199-05", "zone": "Europe/London"}
    with bootstrap.services(home) as services:
        schedules.add(services, "once", "at 2199-05-04T23:30:00Z", Work("plate", ("simulate",)), zone="UTC")
    told = desk.get("/api/v1/schedules/calendar", params=at).json()
    assert [(one["day"], one["first"]) for one in told if one["schedule"] == "once"] == [
        ("2199-05-05", "2199-05-04T23:30:00+00:00")
    ]
