"""A result is stale where what it would be made of now is another, however far back."""

from __future__ import annotations

from datetime import UTC, datetime

from support.archives import Clock, registered, run_jobs

from sms_jobs.archive import Archive
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.asking import campaign_matrix, explanation
from sms_jobs.jobs.planning.graph import Request

KINDS = ("simulate", "reconstruct", "correlate", "strain", "merge")


def stale(catalogue: Catalogue) -> set[tuple[str, str | None]]:
    """Return kind and state of what is shown as stale."""
    with catalogue.reading() as session:
        cells = campaign_matrix.matrix(session, campaigns.campaign_row(session, "plate"), datetime.now(UTC))
    return {(cell.kind, cell.state) for cell in cells if cell.condition == "stale"}


def reasons(catalogue: Catalogue) -> dict[tuple[str, str | None], str]:
    """Return why each stale result is shown as stale."""
    with catalogue.reading() as session:
        cells = campaign_matrix.matrix(session, campaigns.campaign_row(session, "plate"), datetime.now(UTC))
    assert all(bool(cell.why) == (cell.condition == "stale") for cell in cells)
    return {(cell.kind, cell.state): cell.why for cell in cells if cell.why}


def explained(catalogue: Catalogue, job: str) -> list[str]:
    with catalogue.reading() as session:
        told = explanation.explain(session, session.get_one(JobRow, job), datetime.now(UTC))
    return [line for line in told if "stale" in line]


def test_what_was_made_of_an_input_that_was_made_again_is_stale_however_far_down(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    jobs = run_jobs(catalogue, archive, clock, [Request(kind) for kind in KINDS])
    assert stale(catalogue) == set()
    with catalogue.reading() as session:
        of = {(row.kind, row.subject): row.id for row in (session.get_one(JobRow, job) for job in jobs)}

    run_jobs(catalogue, archive, clock, [Request("correlate", {"subset_radius_px": 12})])
    assert stale(catalogue) == {("strain", "S01"), ("merge", "S01")}
    assert explained(catalogue, of["strain", "plate/S01/C1P1"]) == [
        "it is stale: its input correlate plate/S01/C1P1 was made again, with other contents"
    ]
    assert any("is stale" in line for line in explained(catalogue, of["merge", "plate/S01"]))

    told = reasons(catalogue)
    for kind, subject in (("strain", "plate/S01/C1P1"), ("merge", "plate/S01")):
        assert explained(catalogue, of[kind, subject]) == [f"it is stale: {told[kind, 'S01']}"]

    # To have gone back makes all of it good again, and nothing else is computed for that.
    run_jobs(catalogue, archive, clock, [Request("correlate")])
    assert stale(catalogue) == set()
    again = run_jobs(catalogue, archive, clock, [Request("strain"), Request("merge")])
    with catalogue.reading() as session:
        assert all(session.get_one(JobRow, job).reused_from for job in again)
