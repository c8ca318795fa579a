"""The tables: typed columns for what people ask, JSON for the rest."""

from datetime import datetime
from typing import Any, ClassVar

from sqlalchemy import (
    JSON,
    BigInteger,
    Enum,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    UniqueConstraint,
    desc,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from sms_jobs.catalogue.tables.columns import MessageText, String, Text, UtcDateTime
from sms_jobs.records.job import JobState

BigId = BigInteger().with_variant(Integer(), "sqlite")
JobStateColumn = Enum(
    JobState,
    name="job_state",
    native_enum=False,
    length=16,
    values_callable=lambda states: [s.value for s in states],
)
DERIVED = "derived"
"""Marks a table that the database fills by itself."""


class Table(DeclarativeBase):
    """Base of all tables; constraints have predictable names so that migrations can refer to them."""

    metadata: ClassVar[MetaData] = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map: ClassVar[dict[Any, Any]] = {
        datetime: UtcDateTime,
        JobState: JobStateColumn,
        dict[str, Any]: JSON,
        dict[str, float]: JSON,
    }


class SpecimenRow(Table):
    """A thing that is tested."""

    __tablename__ = "specimen"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    material: Mapped[str] = mapped_column(Text)
    description: Mapped[str] = mapped_column(Text)


class RigRow(Table):
    """A set of sensors."""

    __tablename__ = "rig"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)


class CampaignRow(Table):
    """A test of one specimen; `definition` is the whole `Campaign` record."""

    __tablename__ = "campaign"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    specimen_id: Mapped[int] = mapped_column(ForeignKey("specimen.id"), index=True)
    rig_id: Mapped[int] = mapped_column(ForeignKey("rig.id"), index=True)
    created_at: Mapped[datetime]
    definition: Mapped[dict[str, Any]] = mapped_column(deferred=True)
    """Read only where it is asked for: with hundreds of states that takes longer than all else."""
    definition_hash: Mapped[str] = mapped_column(String(64))
    views: Mapped[list[str]] = mapped_column(JSON, server_default="[]")
    """As the definition has them, which with hundreds of states takes long to read."""
    frames: Mapped[int] = mapped_column(server_default="0")
    """Of its whole fringe sequence."""
    frame: Mapped[str | None] = mapped_column(String(16))
    """How the specimen's frame was found; None where nobody has."""
    plan: Mapped[str | None] = mapped_column(Text)
    """The file that it was made from, letter by letter; None where it was made by a program."""


class LoadStateRow(Table):
    """One load case of a campaign."""

    __tablename__ = "load_state"
    __table_args__ = (UniqueConstraint("campaign_id", "label"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaign.id"))
    label: Mapped[str] = mapped_column(String(64), index=True)
    position: Mapped[int]
    load_n: Mapped[float | None] = mapped_column(index=True)
    """As it was entered from readings, else as it is planned; what was recorded is in `ReadingRow`."""
    displacement_mm: Mapped[float | None]
    planned_load_n: Mapped[float | None] = mapped_column(index=True)
    planned_displacement_mm: Mapped[float | None]
    time: Mapped[datetime | None] = mapped_column(index=True)


class ChannelRow(Table):
    """A scalar reading at a state."""

    __tablename__ = "channel"
    __table_args__ = (Index(None, "name", "value"),)
    state_id: Mapped[int] = mapped_column(ForeignKey("load_state.id"), primary_key=True)
    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    value: Mapped[float]


class WorkerRow(Table):
    """A supervisor and the processes that it looks after."""

    __tablename__ = "worker"
    id: Mapped[str] = mapped_column(String(16), primary_key=True)
    """Drawn for each run of a supervisor; names of hosts and numbers of processes may be given twice."""
    host: Mapped[str] = mapped_column(String(128))
    pid: Mapped[int]
    machine: Mapped[str] = mapped_column(String(64), default="")
    boot: Mapped[str] = mapped_column(String(64), default="")
    pid_namespace: Mapped[str] = mapped_column(String(64), default="")
    process_started: Mapped[int] = mapped_column(BigInteger, default=0)
    """Where the process can be looked for; see `jobs.origin`."""
    queues: Mapped[str] = mapped_column(Text)
    concurrency: Mapped[int]
    processes: Mapped[int]
    """How many of them live."""
    lease_s: Mapped[float]
    beats: Mapped[int] = mapped_column(BigInteger, default=0)
    """Others know by its changing that this one lives."""
    given_up: Mapped[bool] = mapped_column(default=False)
    """Silent until its next beat."""
    started_at: Mapped[datetime]
    beat_at: Mapped[datetime]
    draining: Mapped[bool] = mapped_column(default=False)
    held_for: Mapped[str | None] = mapped_column(Text)
    """Why it claims nothing for now: from its host the archive cannot be used. It goes on by itself."""
    held_at: Mapped[str | None] = mapped_column(String(200))
    """The subject whose folder of the archive was at fault."""


class JobRow(Table):
    """A job; this row is the only truth about its state."""

    __tablename__ = "job"
    __table_args__ = (
        # In the order in which jobs are claimed, so that a claim looks at one of ten thousand.
        Index("ix_job_next", "state", desc("priority"), "position", "queue"),
        Index(None, "kind", "finished_at"),
        Index(None, "campaign_id", "position"),
        # All that counting the jobs of a campaign or submission asks for.
        Index(None, "campaign_id", "state", "submitted_at"),
        Index(None, "reuse_key", "state"),
        Index(None, "worker_id", "state"),
        # The latest, of all or of those of a kind or in a state, whatever they are about.
        Index(None, "position"),
        Index(None, "kind", "position"),
        Index(None, "state", "position"),
        # How fast jobs come along is asked by every page.
        Index(None, "started_at"),
        Index(None, "finished_at"),
    )
    id: Mapped[str] = mapped_column(String(16), primary_key=True)
    kind: Mapped[str] = mapped_column(String(32))
    kind_version: Mapped[int]
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaign.id"))
    subject: Mapped[str] = mapped_column(String(200), index=True)
    parameters: Mapped[dict[str, Any]]
    queue: Mapped[str] = mapped_column(String(80))
    priority: Mapped[int] = mapped_column(default=0)
    position: Mapped[int] = mapped_column(BigInteger)
    """Order of submission; smaller is earlier."""
    repeatable: Mapped[bool]
    use_cache: Mapped[bool] = mapped_column(default=True)
    state: Mapped[JobState]
    submitted_at: Mapped[datetime]
    submitted_by: Mapped[str] = mapped_column(String(80), default="", server_default="")
    """The person, account or schedule that asked for it."""
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]
    attempts: Mapped[int] = mapped_column(default=0)
    crashes: Mapped[int] = mapped_column(default=0)
    tries: Mapped[int] = mapped_column(default=0)
    """How often it failed by what may pass by itself, and was queued again for it."""
    fence: Mapped[int] = mapped_column(default=0)
    """Grows with every claim; an attempt that holds an older one may write nothing."""
    worker_id: Mapped[str | None] = mapped_column(ForeignKey("worker.id"))
    pid: Mapped[int | None]
    stop_asked_at: Mapped[datetime | None]
    """Since when it is to stop; `stop_as` says how it then ends, `stop_reason` why."""
    stop_as: Mapped[JobState | None]
    stop_reason: Mapped[str | None] = mapped_column(MessageText)
    progress: Mapped[float] = mapped_column(default=0.0)
    message: Mapped[str] = mapped_column(MessageText, default="")
    error: Mapped[str | None] = mapped_column(MessageText)
    reuse_key: Mapped[str | None] = mapped_column(String(64))
    reused_from: Mapped[str | None] = mapped_column(ForeignKey("job.id"))


class JobCountRow(Table):
    """How many jobs of a campaign, kind and queue are in a state: the sum of `jobs` over all parts.

    Nobody writes it but triggers on `job`; see `catalogue.job_counts`.
    """

    __tablename__ = "job_count"
    __table_args__ = ({"info": {DERIVED: True}},)
    campaign_id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    kind: Mapped[str] = mapped_column(String(32), primary_key=True)
    queue: Mapped[str] = mapped_column(String(80), primary_key=True)
    state: Mapped[JobState] = mapped_column(primary_key=True)
    part: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    jobs: Mapped[int] = mapped_column(BigInteger)


class EventRow(Table):
    """A change of a job's state; rows are only ever added, and sealed by the chain of `AuditRow`."""

    __tablename__ = "event"
    __table_args__ = (
        Index(None, "job_id", "id"),
        Index("ix_event_seal", "seal_id", "id"),
    )
    id: Mapped[int] = mapped_column(BigId, primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id"))
    at: Mapped[datetime]
    state: Mapped[JobState]
    attempt: Mapped[int]
    message: Mapped[str] = mapped_column(MessageText, default="")
    seal_id: Mapped[int | None] = mapped_column(BigInteger)
    """The link of the chain whose digest holds this row; None until the service has come to it."""
