"""A worker reads the definition of a campaign once, and again when it has changed."""

from __future__ import annotations

from dataclasses import replace

from sqlalchemy import event
from support.jobs import NOW, claim, submit_pipeline

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.campaigns import Definitions
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.running import lifecycle
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.job import JobState


def test_a_definition_is_read_once_and_again_after_a_change(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    definitions = Definitions()
    said: list[str] = []
    event.listen(catalogue.engine, "before_cursor_execute", lambda *a: said.append(a[2]))

    def of_next_job() -> tuple[Campaign, int]:
        held = claim(catalogue)
        assert held is not None
        said.clear()
        with catalogue.reading() as session:
            found = definitions.get(session, held.campaign_id, held.definition_hash)
        with catalogue.writing() as session:
            lifecycle.change(session, held.job_id, JobState.QUEUED, NOW, "again", fence=held.fence)
        return found, sum(one.startswith("SELECT campaign") for one in said)

    first, read = of_next_job()
    assert read == 1
    assert of_next_job() == (first, 0)
    heated = replace(first.states[1], channels={"temperature_C": 80.0})
    after = replace(first, states=(first.states[0], heated))
    with catalogue.writing() as session:
        campaigns.bring_up_to_date(session, campaigns.campaign_row(session, "plate"), after)
    assert of_next_job() == (after, 1)
    assert of_next_job() == (after, 0)


def test_no_more_than_some_definitions_are_kept(catalogue: Catalogue) -> None:
    names = [f"plate{k}" for k in range(campaigns.KEPT_DEFINITIONS + 1)]
    for name in names:
        submit_pipeline(catalogue, name)
    definitions = Definitions()
    with catalogue.reading() as session:
        rows = [campaigns.campaign_row(session, name) for name in names]
        got = [definitions.get(session, row.id, row.definition_hash) for row in rows]
        assert [one.name for one in got] == names
        last = [definitions.get(session, row.id, row.definition_hash) for row in rows[1:]]
        assert all(one is kept for one, kept in zip(last, got[1:], strict=True))
        assert definitions.get(session, rows[0].id, rows[0].definition_hash) is not got[0]
