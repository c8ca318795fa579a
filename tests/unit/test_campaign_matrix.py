"""What there is of a campaign, cell by cell: the same for a command, a program and a page, however large."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime

import httpx2
import numpy as np
import pytest
from sqlalchemy import insert, update
from support.homes import WHEN, make_home, stored
from support.over_http import app_of, served
from support.statements import heard
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.app.specimens import campaign_matrix
from sms_jobs.app.work import new_jobs
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.tables.files import FileRow, ResultRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.cli import campaign as command
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.kinds import all_kinds
from sms_jobs.records.fields import Surface
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.cells import Cell
from sms_jobs.virtual_rig.campaigns import small_plate

FAILED = "no texture: <b>0</b> matches of 900, and 50 are needed; light the specimen"
STATES, VIEWS = 300, 10
SHOWN = 50
"""States that the page shows at once."""


def surface() -> Surface:
    y, x = np.mgrid[0:60, 0:80].astype(float)
    return Surface("C1P1", "mm", np.stack([x, y, x * y]), np.zeros((60, 80), np.uint32))


@pytest.fixture(scope="module")
def services(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Services]:
    """A home with one stale surface, one that holds, a job that failed, and another, very large campaign."""
    home = tmp_path_factory.mktemp("matrix") / "home"
    make_home(home, {})
    with bootstrap.services(home, "web") as services:
        new_jobs.submit(services, Work("plate", ("simulate", "pipeline")))
        for number, state in enumerate(("S00", "S01"), 1):
            file = stored(services, "reconstruct", f"plate/{state}/C1P1", {"surface": surface()}, number)
            version = all_kinds()["reconstruct"].version - (state == "S00")
            with services.catalogue.writing() as session:
                session.add(ResultRow(file_id=file, kind="reconstruct", kind_version=version))
        with services.catalogue.writing() as session:
            of = JobRow.kind == "reconstruct"
            session.execute(update(JobRow).where(of).values(state=JobState.SUCCEEDED))
            of = (JobRow.kind == "correlate") & (JobRow.subject == "plate/S01/C1P1")
            session.execute(update(JobRow).where(of).values(state=JobState.FAILED, error=FAILED))
        many(services)
        yield services


@pytest.fixture(scope="module")
def client(services: Services) -> Iterator[httpx2.Client]:
    with served(app_of(services)) as client:
        yield client


def page_of(client: httpx2.Client, campaign: str, first: int = 1) -> str:
    address = str(client.base_url).removesuffix("/api/v1/") + f"/campaigns/{campaign}"
    answer = client.get(address, params={"first": first})
    assert answer.status_code == 200, answer.text
    return answer.text


def test_a_command_and_a_program_are_told_the_same(services: Services, client: httpx2.Client) -> None:
    told = client.get("campaigns/plate/matrix").json()
    home = str(services.settings.home)
    printed = CliRunner().invoke(command.app, ["matrix", "plate", "--home", home, "--json"])
    assert json.loads(printed.stdout) == told
    cells = {(c["kind"], c["state"], c["view"]): c for c in told}
    now = all_kinds()["reconstruct"].version
    assert cells["reconstruct", "S00", "C1P1"]["condition"] == "stale"
    assert cells["reconstruct", "S00", "C1P1"]["why"] == (
        f"reconstruct is now version {now}, it was made by {now - 1}"
    )
    holds = cells["reconstruct", "S01", "C1P1"]
    assert (holds["condition"], holds["why"], holds["pictured"]) == ("computed", "", True)
    failed = cells["correlate", "S01", "C1P1"]
    assert (failed["condition"], failed["why"], failed["pictured"]) == ("failed", FAILED, False)
    waits = cells["correlate", "S01", "C1P2"]
    assert (waits["condition"], waits["why"]) == ("waiting", "")


def test_cells_are_shown_by_state_and_view_and_not_as_they_came(services: Services) -> None:
    _, plate = small_plate("plate")
    home = str(services.settings.home)
    shown = CliRunner().invoke(command.app, ["matrix", "plate", "--home", home, "--json"])
    places = [(cell["state"], cell["view"]) for cell in json.loads(shown.stdout)]
    each = [(s.label, view) for s in plate.states for view in (*plate.views, None)]
    assert list(dict.fromkeys(places)) == [*each, (None, None)]
    came = [
        Cell(state, view, kind, "computed", None, "", None, "", False)
        for kind in ("measurement", "reconstruct")
        for state, view in (("S01", "C10P1"), ("S01", None), (None, None), ("S01", "C2P1"), ("S00", "C10P1"))
    ]
    assert [(c.state, c.view, c.kind[0]) for c in campaign_matrix.in_order(came, plate)] == [
        (state, view, kind)
        for state, view in (("S00", "C10P1"), ("S01", "C2P1"), ("S01", "C10P1"), ("S01", None), (None, None))
        for kind in "mr"
    ]


def test_the_page_says_why_in_words_that_need_no_mouse(client: httpx2.Client) -> None:
    page = page_of(client, "plate")
    why = dict(re.findall(r'<details class="why" id="why-tuples-([^"]+)">.*?<p>(.*?)</p>', page))
    assert set(why) == {"S00-C1P1-reconstruct", "S01-C1P1-correlate"}
    assert why["S00-C1P1-reconstruct"].startswith("Reconstruct is now version ")
    assert why["S01-C1P1-correlate"] == (
        "No texture: &lt;b&gt;0&lt;/b&gt; matches of 900, and 50 are needed; light the specimen."
    )
    assert "<b>" not in page


def test_a_picture_is_sent_once_and_then_only_asked_about(client: httpx2.Client) -> None:
    (address,) = set(
        re.findall(
            r'<img loading="lazy"[^>]* src="([^"]+)" alt="reconstruct S01 C1P1" width="72"',
            page_of(client, "plate"),
        )
    )
    first = client.get(str(client.base_url).removesuffix("/api/v1/") + address)
    assert first.headers["Cache-Control"] == "private, no-cache"
    tag = first.headers["ETag"]
    for unless in (tag, f"W/{tag}", f'"other", {tag}', "*"):
        again = client.get(first.url, headers={"If-None-Match": unless})
        assert (again.status_code, again.content, again.headers["ETag"]) == (304, b"", tag), unless
    other = client.get(first.url, headers={"If-None-Match": '"other"'})
    assert (other.status_code, other.content) == (200, first.content)
    assert first.content.startswith(b"\x89PNG")


def many(services: Services) -> None:
    """Register a campaign of very many tuples, each with a surface that nobody has to read."""
    _, plate = small_plate("many")
    states = tuple(replace(plate.states[0], label=f"S{k:03}") for k in range(STATES))
    views = tuple(f"C{k}P1" for k in range(1, VIEWS + 1))
    made = replace(plate, states=states, views=views, scene=None)
    register_campaign(services.catalogue, services.archive, made, None, datetime.now(UTC))
    with services.catalogue.writing() as session:
        row = campaigns.campaign_row(session, "many")
        known = campaigns.state_ids(session, row.id)
        rows = [
            {
                "source": kind,
                "path": f"many/{state}/{view}/{kind}",
                "content_hash": "c" * 64,
                "size_bytes": 1,
                "sha256": "c" * 64,
                "media_type": "application/x-hdf5",
                "created_at": WHEN,
                "campaign_id": row.id,
                "state_id": number,
                "view": view,
            }
            for state, number in known.items()
            for view in views
            for kind in ("measurement", "reconstruct", "correlate", "strain")
        ]
        session.execute(insert(FileRow), rows)


def test_very_many_cells_take_no_more_statements_and_no_picture_before_it_is_seen(
    services: Services, client: httpx2.Client
) -> None:
    def statements(campaign: str) -> tuple[int, str]:
        with heard(services.catalogue) as found:
            page = page_of(client, campaign)
        return len(found.statements), page

    statements("many")  # what is looked up once does not count
    few, _ = statements("plate")
    of_many, page = statements("many")
    # Those of the small one have jobs, whose outlook is asked for.
    assert of_many <= few
    shown = re.findall(r"<img [^>]*>", page)
    assert len([one for one in shown if 'width="72" height="54"' in one]) == SHOWN * VIEWS
    assert all('loading="lazy"' in one for one in shown)


def test_states_are_gone_through_portion_by_portion(client: httpx2.Client) -> None:
    seen: list[str] = []
    first = 1
    while True:
        page = page_of(client, "many", first)
        matrix = page[page.index('<section id="matrix"') : page.index('<section id="states"')]
        seen += dict.fromkeys(re.findall(r'id="tuples-(S\d+)-C1P1-strain"', matrix))
        assert f"States {first} to {min(first + SHOWN - 1, STATES)} of {STATES}" in matrix
        before = re.search(r'href="\?first=(\d+)#matrix">Before', matrix)
        assert (before is None) == (first == 1)
        after = re.search(r'href="\?first=(\d+)#matrix">After', matrix)
        if after is None:
            break
        first = int(after[1])
    assert seen == [f"S{k:03}" for k in range(STATES)]
    assert "S299-C1P1" in page_of(client, "many", 10_000)  # behind the last is the last


def test_the_page_shows_views_in_the_order_of_the_command(services: Services, client: httpx2.Client) -> None:
    home = str(services.settings.home)
    words = ["matrix", "many", "--state", "S001", "--home", home, "--json"]
    told = [one["view"] for one in json.loads(CliRunner().invoke(command.app, words).stdout)]
    page = page_of(client, "many")
    for places in (r'id="tuples-S001-(C\d+P1)-strain"', r'<img [^>]*alt="strain S000 (C\d+P1)"'):
        shown = list(dict.fromkeys(re.findall(places, page)))
        assert shown == list(dict.fromkeys(told)) == [f"C{k}P1" for k in range(1, VIEWS + 1)]


def test_some_states_alone_are_told_of(services: Services, client: httpx2.Client) -> None:
    every = client.get("campaigns/plate/matrix").json()
    some = client.get("campaigns/plate/matrix", params={"states": "S01"}).json()
    assert some == [cell for cell in every if cell["state"] in ("S01", None)]
    assert any(cell["state"] is None for cell in some)
    home = str(services.settings.home)
    words = ["matrix", "plate", "--state", "S01", "--home", home, "--json"]
    assert json.loads(CliRunner().invoke(command.app, words).stdout) == some
    unknown = client.get("campaigns/plate/matrix", params={"states": "S09"})
    assert unknown.status_code == 404
    assert unknown.json()["error"] == (
        "campaign plate has no state S09; 'sms campaign show plate' shows its own"
    )
