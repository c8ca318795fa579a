"""Questions about many campaigns and jobs are few statements, and what answers them is kept right."""

from __future__ import annotations

from itertools import combinations

from alembic import command
from sqlalchemy import select, update
from support.jobs import NOW, claim, submit_pipeline
from support.statements import heard

from sms_jobs.catalogue import campaigns, schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.jobs.planning.estimates import estimate
from sms_jobs.jobs.running import lifecycle
from sms_jobs.records.job import JobState


def statements(catalogue: Catalogue) -> int:
    """Return how many statements an estimate of all jobs and the list of campaigns take."""
    with heard(catalogue) as found, catalogue.reading() as session:
        estimate(session, Chosen(), NOW, 2)
        inquiry.list_campaigns(session, 1000)
    return len(found.statements)


def test_more_campaigns_take_no_more_statements(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue, "first")
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        lifecycle.succeed(session, held, NOW, "took 1 s", reuse_key="k" * 64)
    statements(catalogue)  # what is looked up once does not count
    of_one = statements(catalogue)
    for number in range(3):
        submit_pipeline(catalogue, f"further-{number}")
    assert statements(catalogue) == of_one


def test_jobs_in_several_states_are_listed_in_one_order(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    assert claim(catalogue) is not None
    with catalogue.reading() as session:
        rows = session.execute(select(JobRow.id, JobRow.state).order_by(JobRow.position.desc())).all()
        assert len({state for _, state in rows}) == 3
        for states in combinations(JobState, 2):
            for limit in (3, len(rows)):
                listed = inquiry.list_jobs(session, states=states, limit=limit)
                assert [job.id for job in listed] == [i for i, state in rows if state in states][:limit]
        page = inquiry.list_jobs(session, states=list(JobState), limit=5)
        after = inquiry.list_jobs(session, states=list(JobState), limit=5, after=page[-1].id)
        assert [job.id for job in page + after] == [i for i, _ in rows[:10]]


def test_views_and_frames_of_older_campaigns_are_noted(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.reading() as session:
        row = campaigns.campaign_row(session, "plate")
        defined = campaigns.definition(row)
        older = row.definition | {"sequence": {"densities": [0, 5, 3], "steps": 5}}
    assert (row.views, row.frames) == (list(defined.views), defined.sequence.frames)
    with catalogue.writing() as session:
        session.execute(update(CampaignRow).values(definition=older))
        configuration = schema.configuration()
        configuration.attributes["connection"] = session.connection()
        command.downgrade(configuration, "0102")
    schema.upgrade(catalogue)
    assert schema.differences_from_models(catalogue) == []
    with catalogue.reading() as session:
        row = campaigns.campaign_row(session, "plate")
        assert campaigns.definition(row).sequence.frames == row.frames == 2 * (2 + 5 + 5)
        assert row.views == list(defined.views)
