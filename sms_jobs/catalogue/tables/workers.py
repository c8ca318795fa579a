"""The table of workers."""

from datetime import datetime

from sqlalchemy import BigInteger
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.columns import String, Text


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
