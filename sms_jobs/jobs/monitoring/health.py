"""What may be wrong with an installation, found by looking: each finding says what to do about it."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psutil
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive
from sms_jobs.archive.place import probe
from sms_jobs.catalogue import job_counts, renewal
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.errors import StorageFull, StorageUnusable
from sms_jobs.jobs.running import queues
from sms_jobs.records.sizes import number_of

_LOOK_FOR_S = 8.0

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


def archive_works(archive_root: Path) -> str | None:
    """Do once what sealing does: write a file, force it to the disk, rename it and read it."""
    try:
        probe(archive_root)
    except (StorageFull, StorageUnusable) as fault:
        return str(fault)
    return None


def files_nobody_knows(session: Session, archive: Archive) -> str | None:
    """Find an archive with files beside a catalogue that knows none, and the other way round."""
    registered = session.scalar(select(FileRow.path).limit(1))
    lying = next(archive.files(), None)
    if registered is None and lying is not None:
        return (
            f"the catalogue knows no file, although files lie in the archive {archive.where}; "
            "'sms archive reindex' enters them"
        )
    if registered is not None and lying is None:
        return (
            f"the catalogue knows files, and none lies in the archive {archive.where}; mount its disk or "
            "share, or correct 'archive' in sms.toml"
        )
    return None


def counts_of_jobs(session: Session) -> str | None:
    """Compare the counts of jobs that the catalogue keeps with its jobs."""
    if not job_counts.differ(session):
        return None
    return (
        "the catalogue counts other jobs than it has: something changed them without its triggers; end the "
        "service, then run 'sms db upgrade', which counts them anew"
    )


def damage(catalogue: Catalogue) -> str | None:
    """Find an SQLite catalogue whose file is damaged, as far as that can be seen in a few seconds."""
    file = renewal.file_of(str(catalogue.engine.url))
    found = None if file is None else renewal.damage(file, _LOOK_FOR_S)
    return None if found is None else str(catalogue.damaged(found))


def other_file_systems(archive_root: Path) -> str | None:
    """Find folders of the archive that are on a disk of their own, whose room nobody watches."""
    here = archive_root.stat().st_dev
    elsewhere = [f.name for f in archive_root.iterdir() if f.is_dir() and f.stat().st_dev != here]
    if not elsewhere:
        return None
    return (
        f"'{elsewhere[0]}' in {archive_root} is on another file system, whose free room is not watched; "
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


def held(catalogue: Catalogue, patience_s: float = _LOOK_FOR_S) -> str | None:
    """Find that nobody can write into an SQLite catalogue, since a process that is stopped holds its lock."""
    file = catalogue.engine.url.database
    if catalogue.dialect != "sqlite" or not file:
        return None
    try:
        with closing(
            sqlite3.connect(f"{Path(file).resolve().as_uri()}?mode=rw", patience_s, uri=True)
        ) as own:
            own.execute("BEGIN IMMEDIATE")
            own.rollback()
    except sqlite3.OperationalError as error:
        # An account that only reads cannot tell.
        if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY:
            return (
                f"nobody else could write into the catalogue for {patience_s:.0f} s: 'fuser -v {file}' names "
                "who has it open; continue the process that is stopped, or end it"
            )
    return None


def room(root: Path, least_bytes: float) -> str | None:
    """Find a disk that is nearly full."""
    free = shutil.disk_usage(root).free
    return None if free >= least_bytes else f"only {free / 1e9:.1f} GB free at {root}; make room"


def pauses(session: Session) -> list[str]:
    """Find queues that are paused while jobs wait in them, or because a disk was full."""
    found = []
    for queue in queues.queues(session):
        if queue.paused_at is None or not (queue.queued or queue.for_room):
            continue
        hint = (
            "make room; it goes on by itself while a worker is alive"
            if queue.for_room
            else f"'sms queue resume {queue.name}' lets it go on"
        )
        found.append(
            f"the queue '{queue.name}' is paused since {queue.paused_at:%Y-%m-%d %H:%M} UTC with "
            f"{number_of(queue.queued, 'job')} in it: {queue.reason}; {hint}"
        )
    return found
