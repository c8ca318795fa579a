"""The catalogue's database: its schema, its move to another, and backups."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from sms_jobs import settings as settings_file
from sms_jobs.app import writing
from sms_jobs.app.progress import Step, Tell, nobody
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import copying, job_counts, schema, upkeep
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.keeping import backups
from sms_jobs.jobs.keeping.backups import Progress
from sms_jobs.records.people import Right

SHARES = backups.SHARES
"""In how many backups everything that was copied before is read again, unless it is said otherwise."""


@dataclass(frozen=True)
class Upgraded:
    """The revision that the catalogue has, and whether it had it before."""

    revision: str | None
    already: bool


def upgrade(home: Path | None) -> Upgraded:
    """Bring the catalogue of a home to the schema that this version needs; its jobs are counted anew.

    It takes the home, because services of an older catalogue cannot be opened.
    """
    with closing(Catalogue(settings_file.load(home).catalogue_url)) as catalogue:
        before = schema.current_revision(catalogue)
        schema.upgrade(catalogue)
        with catalogue.writing() as session:
            job_counts.count_again(session)
        after = schema.current_revision(catalogue)
    return Upgraded(after, before == after)


@dataclass(frozen=True)
class Compared:
    """The revision of the catalogue, and how its schema differs from this version's, in sentences."""

    revision: str | None
    differences: tuple[str, ...]


@use_case(Right.READ)
def check(services: Services) -> Compared:
    """Compare the catalogue's schema with what this version needs."""
    differences = schema.differences_from_models(services.catalogue)
    return Compared(schema.current_revision(services.catalogue), tuple(differences))


@dataclass(frozen=True)
class Copied:
    """How many rows were copied, and to where; without secrets."""

    rows: int
    to: str


@use_case(Right.ADMINISTER)
def copy(services: Services, to_url: str, tell: Tell = nobody) -> Copied:
    """Copy the whole catalogue to another database, which has all rows in the end, or none.

    Parameters
    ----------
    to_url
        Of an empty database.
    tell
        Called with the rows that are done.

    Raises
    ------
    Conflict
        The service runs, or the target is not empty.
    ConfigurationError, ServerUnreachable
        The target cannot be used.
    """
    rows = 0
    with closing(Catalogue(to_url, create=True)) as target:
        copying.require_idle(services.catalogue, datetime.now(UTC))
        copying.prepare(target)
        for done in copying.copy(services.catalogue, target):
            rows = done.total
            tell(Step("copying", done.done, done.total, done.table))
        upkeep.analyse(target)
        return Copied(rows, target.describe())


@dataclass(frozen=True)
class Missed:
    """A file that could not be copied, and why."""

    path: str
    finding: str


@dataclass(frozen=True)
class BackedUp:
    """What a backup, or a restoration, came to.

    Attributes
    ----------
    files, size_bytes
        That it consists of.
    copied, read_again
        How many files were copied now, and how many copies were read again.
    findings
        Files that are missing or damaged.
    """

    files: int
    size_bytes: int
    copied: int
    read_again: int
    findings: tuple[Missed, ...]


@use_case(Right.ADMINISTER)
def back_up(
    services: Services, folder: Path, shares: int = SHARES, tell: Tell = nobody
) -> tuple[Path, BackedUp]:
    """Add a backup of the catalogue and the archive to a folder; return where its snapshot lies.

    Parameters
    ----------
    shares
        In how many backups all copies are read again; 1 for all of them now.
    tell
        Called with the bytes that are done.

    Raises `InvalidInput` where the folder cannot be made.
    """
    writing.new_folder(folder)
    steps = backups.back_up(
        services.catalogue, services.archive, services.settings, folder, datetime.now(UTC), shares
    )
    done = _followed("backing up", steps, tell)
    return backups.snapshots(folder)[-1], done


def restore(folder: Path, home: Path, snapshot: str = "", host: str = "", tell: Tell = nobody) -> BackedUp:
    """Make a home of its own, without servers, of a backup.

    Parameters
    ----------
    home
        Folder, empty or not there.
    snapshot
        Beginning of its name; the newest if it is empty.
    host
        Whose rigs and frames come along; this one's if it is empty.
    tell
        Called with the bytes that are done.

    Raises
    ------
    NotFound
        There is no such snapshot or host.
    Conflict
        The home is not empty.
    """
    return _followed("restoring", backups.restore(folder, home, snapshot, host), tell)


def _followed(what: str, steps: Iterator[Progress], tell: Tell) -> BackedUp:
    files = copied = again = total = 0
    findings = []
    for step in steps:
        tell(Step(what, step.done_bytes, step.total_bytes))
        files, copied, again = files + 1, copied + step.copied, again + step.read_again
        total = step.total_bytes or total
        if step.finding:
            findings.append(Missed(step.path, step.finding))
    return BackedUp(files, total, copied, again, tuple(findings))
