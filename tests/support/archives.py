"""A small archive that jobs have filled, and all that the catalogue says of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import count
from typing import Any

from sqlalchemy import select, text
from sqlalchemy.orm import aliased

from sms_jobs.archive import Archive, Checker
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.calibrations import AcceptanceRow, CalibrationRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow, SpecimenRow
from sms_jobs.catalogue.tables.every import METADATA
from sms_jobs.catalogue.tables.files import (
    FileRow,
    MeasurementRow,
    ProvenanceRow,
    ReadingRow,
    ResultRow,
    StatisticRow,
)
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.catalogue.tables.states import ChannelRow, LoadStateRow
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.devices.stations import Stations
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.rebuilding import reindexing
from sms_jobs.jobs.running import recovery
from sms_jobs.jobs.running.runner import Runner
from sms_jobs.virtual_rig.campaigns import small_plate
from support.remembered import Remembering

PLAN = "# the plan, letter by letter: \u00e4 \u2013 \U0001f527\r\n"


class Clock:
    """A second later whenever it is asked."""

    def __init__(self) -> None:
        self._ticks = count()

    def __call__(self) -> datetime:
        return datetime(2026, 3, 1, 12, 0, tzinfo=UTC) + timedelta(seconds=next(self._ticks), microseconds=7)


def registered(catalogue: Catalogue, archive: Archive, clock: Clock, name: str = "plate") -> None:
    """Register a campaign of two states and one view, so that its jobs take little time."""
    calibration, campaign = small_plate(name)
    first = replace(campaign.states[0], load_n=0.0, channels={"temperature_C": 20.5})
    campaign = replace(campaign, states=(first, *campaign.states[1:2]), views=campaign.views[:1])
    register_campaign(catalogue, archive, campaign, calibration, clock(), PLAN)


def run_jobs(
    catalogue: Catalogue, archive: Archive, clock: Clock, requests: Iterable[Request], campaign: str = "plate"
) -> tuple[str, ...]:
    """Submit jobs and run them in this process."""
    with catalogue.writing() as session:
        done = submit(session, campaign, list(requests), clock())
    runner(catalogue, archive, clock).run_queued()
    return done.job_ids


def runner(catalogue: Catalogue, archive: Archive, clock: Clock) -> Runner:
    """Return what runs jobs in this process, those of the home's rigs too, as worker `w1`.

    What a job of the same inputs has made before, for whatever test, is not computed again.
    """
    home = archive.store.root.parent
    return Remembering(
        catalogue,
        archive,
        ["cpu", "io", "acquisition", *Stations(home / "rigs", home / "spool").queues()],
        "w1",
        "here",
        1,
        home / "logs",
        Stations(home / "rigs", home / "spool"),
        clock,
        least_room_mb=0.0,
    )


def emptied(catalogue: Catalogue) -> None:
    """Make a catalogue as it is when a home is new."""
    METADATA.drop_all(catalogue.engine)
    with catalogue.writing() as session:
        session.execute(text("DROP TABLE alembic_version"))
    schema.upgrade(catalogue)


def entered(catalogue: Catalogue, archive: Archive, checker: Checker | None = None) -> None:
    """Enter all files of an archive into a catalogue that knows none; each has to be taken."""
    paths = reindexing.unknown_files(catalogue, archive)
    outcomes = {one.outcome for one in reindexing.reindex(catalogue, archive, paths, checker=checker)}
    assert outcomes == {"indexed"}


def rebuilt(catalogue: Catalogue, archive: Archive, checker: Checker | None = None) -> None:
    """Make a catalogue anew from the files of its archive alone."""
    emptied(catalogue)
    entered(catalogue, archive, checker)


def work_again(catalogue: Catalogue, clock: Clock) -> None:
    """Register worker `w1` in a catalogue that has forgotten it."""
    with catalogue.writing() as session:
        recovery.register_worker(session, "w1", "here", 1, ["cpu", "io", "acquisition"], 2, clock())


def everything(catalogue: Catalogue) -> dict[str, list[Any]]:
    """Return all that a catalogue says of what lies in the archive, without numbers that are its own."""
    output, given = aliased(FileRow), aliased(FileRow)
    files = (
        select(
            FileRow.path,
            FileRow.source,
            FileRow.content_hash,
            FileRow.size_bytes,
            FileRow.sha256,
            FileRow.media_type,
            CampaignRow.name,
            LoadStateRow.label,
            FileRow.view,
            FileRow.job_id,
            ResultRow.kind,
            ResultRow.kind_version,
            MeasurementRow.recorded_at,
            FileRow.recorded_at,
        )
        .outerjoin(CampaignRow, CampaignRow.id == FileRow.campaign_id)
        .outerjoin(LoadStateRow, LoadStateRow.id == FileRow.state_id)
        .outerjoin(ResultRow, ResultRow.file_id == FileRow.id)
        .outerjoin(MeasurementRow, MeasurementRow.file_id == FileRow.id)
    )
    queries = {
        # The order counts: the newest of several results is the one with the highest number.
        "files": files.order_by(FileRow.id),
        "campaigns": select(
            CampaignRow.name,
            SpecimenRow.name,
            SpecimenRow.material,
            RigRow.name,
            CampaignRow.created_at,
            CampaignRow.plan,
            CampaignRow.definition,
        )
        .join(SpecimenRow, SpecimenRow.id == CampaignRow.specimen_id)
        .join(RigRow, RigRow.id == CampaignRow.rig_id)
        .order_by(CampaignRow.id),
        "states": select(
            CampaignRow.name,
            LoadStateRow.label,
            LoadStateRow.position,
            LoadStateRow.load_n,
            LoadStateRow.displacement_mm,
            LoadStateRow.planned_load_n,
            LoadStateRow.planned_displacement_mm,
            LoadStateRow.time,
        )
        .join(CampaignRow, CampaignRow.id == LoadStateRow.campaign_id)
        .order_by(CampaignRow.name, LoadStateRow.position),
        "channels": select(LoadStateRow.label, ChannelRow.name, ChannelRow.value)
        .join(LoadStateRow, LoadStateRow.id == ChannelRow.state_id)
        .order_by(LoadStateRow.label, ChannelRow.name),
        "acceptances": select(
            AcceptanceRow.calibration_id,
            AcceptanceRow.campaign,
            AcceptanceRow.in_use,
            AcceptanceRow.decided_at,
            FileRow.path,
        )
        .join(FileRow, FileRow.id == AcceptanceRow.file_id)
        .order_by(AcceptanceRow.calibration_id, AcceptanceRow.campaign),
        "calibrations": select(
            CalibrationRow.id,
            RigRow.name,
            FileRow.path,
            CalibrationRow.valid_from,
            CalibrationRow.origin,
            CalibrationRow.sensors,
        )
        .join(RigRow, RigRow.id == CalibrationRow.rig_id)
        .join(FileRow, FileRow.id == CalibrationRow.file_id)
        .order_by(CalibrationRow.id),
        "statistics": select(FileRow.path, StatisticRow.name, StatisticRow.value)
        .join(FileRow, FileRow.id == StatisticRow.file_id)
        .order_by(FileRow.path, StatisticRow.name),
        "readings": select(FileRow.path, ReadingRow.name, ReadingRow.value)
        .join(FileRow, FileRow.id == ReadingRow.file_id)
        .order_by(FileRow.path, ReadingRow.name),
        "provenance": select(output.path, ProvenanceRow.role, given.path)
        .join(output, output.id == ProvenanceRow.output_id)
        .join(given, given.id == ProvenanceRow.input_id)
        .order_by(output.path, ProvenanceRow.role),
        "jobs": select(
            JobRow.id,
            JobRow.kind,
            JobRow.kind_version,
            JobRow.subject,
            JobRow.parameters,
            JobRow.queue,
            JobRow.repeatable,
            JobRow.state,
            JobRow.attempts,
            JobRow.reuse_key,
        ).order_by(JobRow.id),
        "dependencies": select(
            DependencyRow.job_id,
            DependencyRow.role,
            DependencyRow.source,
            DependencyRow.subject,
            FileRow.path,
        )
        .outerjoin(FileRow, FileRow.id == DependencyRow.file_id)
        .order_by(DependencyRow.job_id, DependencyRow.role),
    }
    with catalogue.reading() as session:
        return {name: [tuple(row) for row in session.execute(query)] for name, query in queries.items()}
