"""What may be wrong with an installation, found by looking: each finding says what to do about it."""

from __future__ import annotations

import os
import secrets
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psutil
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.models import JobRow, WorkerRow
from sms_jobs.jobs import queues
from sms_jobs.records.job import ALIVE_WITHIN, JobState

_MISSED_FOR = timedelta(days=1)
"""A worker that vanished is a finding for so long."""

_ON_THE_NETWORK = frozenset({"nfs", "nfs4", "cifs", "smb", "smb3", "smbfs", "afs", "9p", "fuse.sshfs"})


def database_version(session: Session) -> str:
    """Return which database the catalogue is on, with its version."""
    if session.get_bind().dialect.name == "sqlite":
        return f"SQLite {session.scalar(select(func.sqlite_version()))}"
    return f"PostgreSQL {str(session.scalar(select(func.current_setting('server_version')))).split()[0]}"


def clock(catalogue: Catalogue, lease: timedelta) -> str | None:
    """Compare this machine's clock with the database's; leases are written and judged by several clocks."""
    if catalogue.dialect == "sqlite":
        return None  # it has no clock but this machine's
    with catalogue.reading() as session:
        session.execute(select(1))  # the connection is made before time is taken
        before = datetime.now(UTC)
        theirs = session.scalar(select(func.clock_timestamp()))
        after = datetime.now(UTC)
    if theirs is None:
        return None
    return clock_finding(before + (after - before) / 2 - theirs, lease)


def clock_finding(ahead: timedelta, lease: timedelta) -> str | None:
    """Judge by how much this machine's clock is ahead of the database's."""
    limit = lease / 10
    if abs(ahead) <= limit:
        return None
    word = "ahead of" if ahead > timedelta(0) else "behind"
    return (
        f"this machine's clock is {abs(ahead).total_seconds():.1f} s {word} the database's, more than "
        f"{limit.total_seconds():.1f} s, a tenth of the lease; set both by NTP ('timedatectl set-ntp true')"
    )


def archive_writes(archive: Archive) -> str | None:
    """Do once what sealing does: write a file, force it to the disk, and rename it."""
    growing = archive.root / f".doctor-{secrets.token_hex(4)}"
    sealed = growing.with_name(f"{growing.name}-renamed")
    try:
        with growing.open("xb") as stream:
            stream.write(b"sms doctor")
            stream.flush()
            os.fsync(stream.fileno())
        growing.replace(sealed)
        whole = sealed.read_bytes() == b"sms doctor"
    except OSError as error:
        return (
            f"{archive.root} cannot be written to ({error.strerror}); give this account write permission, or "
            "correct 'archive' in sms.toml"
        )
    finally:
        for left in (growing, sealed):
            left.unlink(missing_ok=True)
    return None if whole else f"{archive.root} does not keep what is written; use another file system"


def other_file_systems(archive: Archive) -> str | None:
    """Find folders of the archive that are on a disk of their own, whose room nobody watches."""
    here = archive.root.stat().st_dev
    elsewhere = [f.name for f in archive.root.iterdir() if f.is_dir() and f.stat().st_dev != here]
    if not elsewhere:
        return None
    return (
        f"'{elsewhere[0]}' in {archive.root} is on another file system, whose free room is not watched; "
        "keep the archive on one, and set 'archive' in sms.toml to it"
    )


def database_on_network(catalogue: Catalogue) -> str | None:
    """Find an SQLite catalogue on a network file system, where its locks do not hold."""
    file = catalogue.engine.url.database
    if catalogue.dialect != "sqlite" or not file:
        return None
    path = Path(file).resolve()
    mounts = {Path(p.mountpoint): p.fstype for p in psutil.disk_partitions(all=True)}
    mount = next((folder for folder in path.parents if folder in mounts), None)
    if mount is None or mounts[mount] not in _ON_THE_NETWORK:
        return None
    return (
        f"the catalogue {path} is on a network file system ({mounts[mount]}), where SQLite may lose data; "
        "move the home to a disk of this machine, or go to PostgreSQL with 'sms db copy'"
    )


def room(root: Path, least_bytes: float) -> str | None:
    """Find a disk that is nearly full."""
    free = shutil.disk_usage(root).free
    return None if free >= least_bytes else f"only {free / 1e9:.1f} GB free at {root}; make room"


def pauses(session: Session) -> str | None:
    """Find a queue that is paused while jobs wait in it, or because a disk was full."""
    for queue in queues.queues(session):
        if queue.paused_at is None or not (queue.queued or queue.for_room):
            continue
        hint = (
            "make room; it goes on by itself while a worker is alive"
            if queue.for_room
            else f"'sms queue resume {queue.name}' lets it go on"
        )
        return (
            f"the queue '{queue.name}' is paused since {queue.paused_at:%Y-%m-%d %H:%M} UTC with "
            f"{queue.queued} jobs in it: {queue.reason}; {hint}"
        )
    return None


def workers(session: Session, now: datetime) -> str | None:
    """Find jobs that nobody runs, and workers that vanished without another in their place."""
    rows = session.scalars(select(WorkerRow).where(WorkerRow.beat_at >= now - _MISSED_FOR)).all()
    alive = [row for row in rows if now - row.beat_at <= ALIVE_WITHIN]
    serving = [row for row in alive if not row.draining]
    queued, running = (
        session.scalar(select(func.count()).select_from(JobRow).where(JobRow.state == state)) or 0
        for state in (JobState.QUEUED, JobState.RUNNING)
    )
    if queued and not serving:
        return f"{queued} jobs are queued and no worker is there that takes them; start one with 'sms up'"
    if running and not alive:
        return f"{running} jobs count as running and no worker is alive; 'sms up' recovers them"
    for row in rows:
        replaced = any(other.host == row.host and other.started_at > row.started_at for other in alive)
        if row in alive or row.draining or replaced:
            continue
        return (
            f"worker {row.id} on {row.host} gave its last sign of life at {row.beat_at:%Y-%m-%d %H:%M} UTC; "
            "look at that host, and start the service there again ('sms up', or 'systemctl start sms')"
        )
    return None
