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
from sqlalchemy import Table as SqlTable
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, validates

from sms_jobs.catalogue.tables.columns import MessageText, String, Text, UtcDateTime
from sms_jobs.records.job import JobState
from sms_jobs.records.views import view_of

BigId = BigInteger().with_variant(Integer(), "sqlite")
JobStateColumn = Enum(
    JobState,
    name="job_state",
    native_enum=False,
    length=16,
    values_callable=lambda states: [s.value for s in states],
)


_DERIVED = "derived"


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


class FileRow(Table):
    """A sealed file of the archive, whatever it holds."""

    __tablename__ = "file"
    __table_args__ = (
        Index(None, "campaign_id", "source", "state_id", "view", "id"),
        # In these, all that is equal lies in the order of ids, so that the newest are found first.
        Index(None, "campaign_id", "source", "id"),
        Index(None, "source", "id"),
    )
    id: Mapped[int] = mapped_column(BigId, primary_key=True)
    source: Mapped[str] = mapped_column(String(32))
    """measurement, calibration, or the kind of job whose result it is."""
    path: Mapped[str] = mapped_column(Text, unique=True)
    content_hash: Mapped[str] = mapped_column(String(64))
    size_bytes: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64), default="")
    """Of the file's bytes; empty where it was not known when the file was entered."""
    media_type: Mapped[str] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(index=True)
    recorded_at: Mapped[datetime | None] = mapped_column(index=True)
    """When the last of the recordings that it shows was started; see `catalogue.lineage`."""
    campaign_id: Mapped[int | None] = mapped_column(ForeignKey("campaign.id"))
    state_id: Mapped[int | None] = mapped_column(ForeignKey("load_state.id"), index=True)
    view: Mapped[str | None] = mapped_column(String(16))
    camera: Mapped[str | None] = mapped_column(String(8))
    """The reference camera of the view."""
    projector: Mapped[str | None] = mapped_column(String(8))
    job_id: Mapped[str | None] = mapped_column(ForeignKey("job.id"), index=True)

    @validates("view")
    def _name_its_sensors(self, _: str, view: str | None) -> str | None:
        seen = None if view is None else view_of(view)
        self.camera = None if seen is None else seen.camera
        self.projector = seen.projector if seen is not None and seen.projectors else None
        return view


class CalibrationRow(Table):
    """A calibration of a rig, valid from a time on."""

    __tablename__ = "calibration"
    __table_args__ = (Index(None, "rig_id", "valid_from"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    rig_id: Mapped[int] = mapped_column(ForeignKey("rig.id"))
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), unique=True)
    valid_from: Mapped[datetime]
    origin: Mapped[str] = mapped_column(Text)
    sensors: Mapped[dict[str, Any]]
    """Role, columns and rows of each of its sensors, by name, in their order."""


class AcceptanceRow(Table):
    """The last decision whether a calibration is used; without one it is not."""

    __tablename__ = "acceptance"
    __table_args__ = (Index(None, "campaign"),)
    calibration_id: Mapped[int] = mapped_column(ForeignKey("calibration.id"), primary_key=True)
    campaign: Mapped[str] = mapped_column(String(64), primary_key=True)
    """Name of the only campaign that it is about; empty for all of the rig that have none of their own."""
    in_use: Mapped[bool]
    decided_at: Mapped[datetime]
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), unique=True)


class CalibrationUseRow(Table):
    """A file was computed with a calibration, directly or through what it was computed from."""

    __tablename__ = "calibration_use"
    __table_args__ = (Index(None, "file_id"),)
    calibration_id: Mapped[int] = mapped_column(ForeignKey("calibration.id"), primary_key=True)
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)


class MeasurementRow(Table):
    """What one view recorded at one state."""

    __tablename__ = "measurement"
    __table_args__ = (Index(None, "state_id", "view", "recorded_at"),)
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    state_id: Mapped[int] = mapped_column(ForeignKey("load_state.id"))
    view: Mapped[str] = mapped_column(String(16))
    recorded_at: Mapped[datetime] = mapped_column(index=True)


class ResultRow(Table):
    """What a job computed: one file of its outputs."""

    __tablename__ = "result"
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    kind: Mapped[str] = mapped_column(String(32), index=True)
    kind_version: Mapped[int]


class StatisticRow(Table):
    """A number that a file can be found by."""

    __tablename__ = "statistic"
    __table_args__ = (Index(None, "name", "value", "file_id"),)
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    value: Mapped[float]


class ReadingRow(Table):
    """What a scalar channel read while the frames of a file, or those behind it, were recorded."""

    __tablename__ = "reading"
    __table_args__ = (Index(None, "name", "value", "file_id"),)
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    value: Mapped[float]


class ProvenanceRow(Table):
    """An edge of the provenance graph: `output` was computed from `input`."""

    __tablename__ = "provenance"
    output_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    role: Mapped[str] = mapped_column(String(256), primary_key=True)
    input_id: Mapped[int] = mapped_column(ForeignKey("file.id"), index=True)


class PinRow(Table):
    """A file that stays whatever a policy says."""

    __tablename__ = "pin"
    file_id: Mapped[int] = mapped_column(ForeignKey("file.id"), primary_key=True)
    reason: Mapped[str] = mapped_column(Text)
    pinned_at: Mapped[datetime]


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
    __table_args__ = ({"info": {_DERIVED: True}},)
    campaign_id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    kind: Mapped[str] = mapped_column(String(32), primary_key=True)
    queue: Mapped[str] = mapped_column(String(80), primary_key=True)
    state: Mapped[JobState] = mapped_column(primary_key=True)
    part: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    jobs: Mapped[int] = mapped_column(BigInteger)


class DependencyRow(Table):
    """One input of a job: a file, or the job that will produce it."""

    __tablename__ = "dependency"
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id"), primary_key=True)
    role: Mapped[str] = mapped_column(String(256), primary_key=True)
    source: Mapped[str] = mapped_column(String(32))
    subject: Mapped[str] = mapped_column(String(200))
    producer_id: Mapped[str | None] = mapped_column(ForeignKey("job.id"), index=True)
    file_id: Mapped[int | None] = mapped_column(ForeignKey("file.id"), index=True)


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


class OutboxRow(Table):
    """A message that is to be sent once the transaction that wrote this row is committed."""

    __tablename__ = "outbox"
    id: Mapped[int] = mapped_column(BigId, primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id"))
    queue: Mapped[str] = mapped_column(String(80))


class QueueRow(Table):
    """A queue that is paused, or was; one without a row never was."""

    __tablename__ = "queue"
    name: Mapped[str] = mapped_column(String(80), primary_key=True)
    paused_at: Mapped[datetime | None]
    reason: Mapped[str] = mapped_column(Text)
    for_room: Mapped[bool]
    """Paused because a disk is full: it goes on by itself once there is room."""


class SavedQueryRow(Table):
    """A question to the archive that somebody wants to ask again."""

    __tablename__ = "saved_query"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    text: Mapped[str] = mapped_column(Text)
    saved_at: Mapped[datetime]


class JobDeviceRow(Table):
    """A device that a job has to hold while it runs."""

    __tablename__ = "job_device"
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id"), primary_key=True)
    device: Mapped[str] = mapped_column(String(128), primary_key=True)


class LockRow(Table):
    """A device that is held: by an attempt of a job for as long as that runs, or by a person for a while.

    The row of a device outlives its holder; only `jobs.locks` can say whether it is held.
    """

    __tablename__ = "lock"
    device: Mapped[str] = mapped_column(String(128), primary_key=True)
    job_id: Mapped[str | None] = mapped_column(ForeignKey("job.id"), index=True)
    fence: Mapped[int | None]
    holder: Mapped[str | None] = mapped_column(String(128))
    """A person or program that is no job, until `lease_until`."""
    lease_until: Mapped[datetime | None]
    taken_at: Mapped[datetime | None]


def written_tables() -> list[SqlTable]:
    """Return the tables that the program writes itself, those first that others refer to."""
    return [table for table in Table.metadata.sorted_tables if _DERIVED not in table.info]
