"""A recording tells when its state was held, and which calibration holds for it, planned before or after."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import select
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.files import FileRow, MeasurementRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.jobs.archiving.registration import register_calibration, register_campaign
from sms_jobs.jobs.asking import explanation
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.running import recovery
from sms_jobs.jobs.running.runner import Runner
from sms_jobs.records.sensors import Calibration
from sms_jobs.virtual_rig.campaigns import small_plate

RIG = """
name = "bench"
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128 }]
projectors = [{ name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 1.0 }]
"""


@pytest.fixture
def services(tmp_path: Path) -> Iterator[Services]:
    initialised(tmp_path / "home")
    (tmp_path / "rig.toml").write_text(RIG)
    with bootstrap.services(tmp_path / "home") as made:
        made.stations.add(tmp_path / "rig.toml", replace=False)
        with made.catalogue.writing() as session:
            recovery.register_worker(session, "w1", "here", 1, ["cpu", "rig-bench"], 1, now())
        yield made


def now() -> datetime:
    return datetime.now(UTC)


def calibrate(services: Services, valid_from: datetime) -> str:
    """Take a calibration of the rig into use; return where it lies."""
    made: Calibration = small_plate("plate")[0]
    rig = replace(made.rig, name="bench")
    calibration = replace(made, rig=rig, valid_from=valid_from, origin=valid_from.isoformat())
    number = register_calibration(
        services.catalogue, services.archive, calibration, now(), accepted=True
    ).number
    with services.catalogue.reading() as session:
        found = session.scalars(select(FileRow.path).where(FileRow.source == "calibration")).all()
    return found[number - 1]


def submitted(services: Services, *kinds: str) -> tuple[str, ...]:
    with services.catalogue.writing() as session:
        return submit(session, "plate", [Request(kind, {}, ("S00",)) for kind in kinds], now()).job_ids


def run(services: Services) -> None:
    home = services.settings.home
    Runner(
        services.catalogue,
        services.archive,
        ["cpu", "rig-bench"],
        "w1",
        "here",
        1,
        home / "logs",
        services.stations,
        now,
        least_room_mb=0.0,
    ).run_queued()


def calibration_of(services: Services, job: str) -> str:
    with services.catalogue.reading() as session:
        query = select(FileRow.path).join(DependencyRow, DependencyRow.file_id == FileRow.id)
        return session.scalars(
            query.where(DependencyRow.job_id == job, DependencyRow.source == "calibration")
        ).one()


def test_a_recording_takes_the_calibration_of_its_own_time(services: Services) -> None:
    _, campaign = small_plate("plate")
    states = tuple(replace(s, time=None) for s in campaign.states)
    plan = replace(campaign, rig="bench", views=("C1P1",), states=states)
    register_campaign(services.catalogue, services.archive, plan, None, now())
    calibrate(services, now() - timedelta(days=1))
    _, shape = submitted(services, "acquire", "reconstruct")
    # Calibrated after the jobs were planned, and before the specimen was recorded.
    valid = calibrate(services, now())
    run(services)
    assert calibration_of(services, shape) == valid
    with services.catalogue.reading() as session:
        state = session.scalars(select(LoadStateRow).where(LoadStateRow.label == "S00")).one()
        assert state.time == session.scalars(select(MeasurementRow.recorded_at)).one()
    # Calibrated afterwards: nothing is stale, and nothing is computed again.
    calibrate(services, now())
    (again,) = submitted(services, "reconstruct")
    run(services)
    with services.catalogue.reading() as session:
        assert session.get_one(JobRow, again).reused_from == shape
        told = explanation.explain(session, session.get_one(JobRow, shape), now())
    assert not [line for line in told if "stale" in line]
    assert calibration_of(services, again) == valid
