"""Jobs, and what happens to them, name the person who asked for it."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import pytest
from support.deployments import Deployment
from support.homes import make_home

from sms_jobs import bootstrap
from sms_jobs.app.work import jobs, new_jobs, queues
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.bootstrap import Services
from sms_jobs.jobs.running import lifecycle, recovery
from sms_jobs.jobs.scheduling import firing
from sms_jobs.jobs.scheduling import schedules as scheduling
from sms_jobs.jobs.scheduling.schedules import Order
from sms_jobs.records.people import Actor, Role

WORK = Work("plate", ("simulate",))


def named(services: Services, name: str) -> Services:
    return services.acting(Actor(name, Role.ADMINISTRATOR, "web", "here"))


@pytest.fixture
def desk(deployment: Deployment) -> Iterator[Services]:
    make_home(deployment.home, deployment.environment)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in deployment.environment.items():
            patch.setenv(name, value)
        with bootstrap.services(deployment.home) as services:
            yield services


def last_message(services: Services, job_id: str) -> str:
    return jobs.show(services, job_id).events[-1].message


def test_a_job_and_its_events_name_who_asked(desk: Services) -> None:
    anna, ben = named(desk, "anna"), named(desk, "ben")
    first, second, *_ = new_jobs.submit(anna, WORK).job_ids
    assert jobs.show(desk, first).job.submitted_by == "anna"
    assert {job.submitted_by for job in jobs.list_jobs(desk)} == {"anna"}
    jobs.cancel(ben, [first], None)
    assert last_message(desk, first) == "cancelled by ben before it ran"
    jobs.retry(anna, [first], None)
    assert last_message(desk, first) == "retried by anna"
    jobs.cancel(anna, [], "plate")
    assert last_message(desk, second) == "cancelled by anna before it ran"
    jobs.retry(ben, [], "plate")
    assert last_message(desk, second) == "retried by ben"


def test_a_running_job_hears_who_stops_it(desk: Services) -> None:
    new_jobs.submit(desk, WORK)
    with desk.catalogue.writing() as session:
        recovery.register_worker(session, "w1", "here", 1, ["cpu", "io", "acquisition"], 1, datetime.now(UTC))
        held = lifecycle.claim(session, ["cpu", "io", "acquisition"], "w1", 1, datetime.now(UTC))
    assert held is not None
    jobs.cancel(named(desk, "anna"), [held.job_id], None)
    with (
        desk.catalogue.writing() as session,
        pytest.raises(lifecycle.Cancelled, match=r"^cancelled by anna$"),
    ):
        lifecycle.report_progress(session, held, 0.5, "half")


def test_a_schedule_names_itself(desk: Services) -> None:
    expression = scheduling.parse_expression("every 1h", "UTC")
    now = datetime.now(UTC)
    scheduling.add(desk.catalogue, "nightly", expression, Order("plate", tuple(WORK.requests)), now)
    firing.fire_due(desk.catalogue, now + timedelta(hours=1))
    assert {job.submitted_by for job in jobs.list_jobs(desk)} == {"schedule nightly"}


def test_a_pause_names_who_paused_unless_there_is_a_reason(desk: Services) -> None:
    for reason, said in (("", "paused by anna"), ("the hall is in use", "the hall is in use")):
        queues.pause(named(desk, "anna"), ["cpu"], reason)
        assert {q.reason for q in queues.list_queues(desk) if q.paused_at is not None} == {said}
        queues.resume(desk, [])
