"""The archive: compared with what was sealed, entered again, repaired and tidied up."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sms_jobs.app.progress import Step, Tell, nobody
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import sealing, upkeep
from sms_jobs.jobs.keeping import archive_state, retention, verification
from sms_jobs.jobs.keeping import repair as repairing
from sms_jobs.jobs.keeping.repair import Repair
from sms_jobs.jobs.keeping.retention import Removable
from sms_jobs.jobs.keeping.verification import Checked, Finding
from sms_jobs.jobs.rebuilding import reindexing
from sms_jobs.jobs.rebuilding.reindexing import Reindexing
from sms_jobs.jobs.recording import left_frames
from sms_jobs.jobs.recording.left_frames import LeftFrames
from sms_jobs.kinds import kind_named
from sms_jobs.records.people import Right
from sms_jobs.records.shown.archive_state import ArchiveState

_ENTERED_AT_ONCE = 100


@dataclass(frozen=True)
class Verified:
    """How many files were compared, their size, and what is not as it should be."""

    files: int
    size_bytes: int
    findings: tuple[Finding, ...]


@use_case(Right.COMPUTE)
def verify(
    services: Services,
    *,
    campaign: str | None = None,
    quick: bool = False,
    after: int = 0,
    tell: Tell = nobody,
    passed: Callable[[int], None] = lambda number: None,
) -> Verified:
    """Read every file of the archive, or of a campaign, and compare it with the catalogue.

    Unless only files of a campaign are looked at, those that the catalogue does not know are findings too,
    and what is not as it was written in the chain that says who did what. Of each file it is noted when it
    was compared and what was found; a quick look notes what is wrong alone.

    Parameters
    ----------
    quick
        Look at presence and size alone.
    after
        Go on after the file of this number.
    tell
        Called with the bytes that have been read.
    passed
        Called with the number of each file that has been compared.

    Raises `NotFound` where there is no such campaign.
    """
    with services.catalogue.reading() as session:
        extent = verification.extent(session, after, campaign)
    findings, fresh = [], list[Checked]()
    try:
        for done in _checked(services, tell, extent.size_bytes, after, campaign, quick):
            passed(done.file_id)
            fresh.append(done)
            if done.finding is not None:
                findings.append(done.finding)
            if len(fresh) >= _ENTERED_AT_ONCE:
                _enter(services, fresh, quick)
    finally:
        # What was compared stays known where somebody breaks off.
        _enter(services, fresh, quick)
    if campaign is None:
        findings += verification.check_unknown(services.catalogue, services.archive)
        if services.catalogue.may_write:
            sealing.seal(services.catalogue, datetime.now(UTC))
        findings += verification.check_audit(services.catalogue)
    return Verified(extent.files, extent.size_bytes, tuple(findings))


def _enter(services: Services, fresh: list[Checked], quick: bool) -> None:
    """Enter what was found of some files, where that can be written, and forget them here."""
    if fresh and services.catalogue.may_write:
        with services.catalogue.writing() as session:
            archive_state.enter(session, fresh, datetime.now(UTC), quick=quick)
    fresh.clear()


@use_case(Right.READ)
def state(services: Services) -> ArchiveState:
    """Return when files were compared with what was sealed, by campaign, which are due and which damaged."""
    with services.catalogue.reading() as session:
        return archive_state.state(session, datetime.now(UTC))


def _checked(
    services: Services, tell: Tell, size: int, after: int, campaign: str | None, quick: bool
) -> Iterator[Checked]:
    read = 0
    for done in verification.check_known(
        services.catalogue, services.archive, after=after, campaign=campaign, quick=quick
    ):
        read += done.size_bytes
        tell(Step("verifying", read, size))
        yield done


@use_case(Right.ADMINISTER)
def reindex(services: Services, *, dry_run: bool = False, tell: Tell = nobody) -> Reindexing:
    """Enter the files of the archive that the catalogue does not know; `tell` counts files."""
    paths = reindexing.unknown_files(services.catalogue, services.archive)
    done = []
    for one in reindexing.reindex(services.catalogue, services.archive, paths, dry_run=dry_run):
        done.append(one)
        tell(Step("reindexing", len(done), len(paths)))
    if done and not dry_run:
        upkeep.analyse(services.catalogue)
    return Reindexing(tuple(done))


@dataclass(frozen=True)
class Repaired:
    """What was done, or would be, and what could not be done after all."""

    repairs: tuple[Repair, ...]
    undone: tuple[Repair, ...]


@use_case(Right.ADMINISTER)
def repair(services: Services, *, dry_run: bool = True, quick: bool = False, tell: Tell = nobody) -> Repaired:
    """Verify the archive and repair what can be repaired; nothing is ever deleted.

    Parameters
    ----------
    dry_run
        Only say what would be done.
    quick
        Look at presence and size alone.
    tell
        Called with the bytes that have been read.
    """
    catalogue, archive = services.catalogue, services.archive
    with catalogue.reading() as session:
        extent = verification.extent(session)
    checked = _checked(services, tell, extent.size_bytes, 0, None, quick)
    findings = [done.finding for done in checked if done.finding is not None]
    findings += verification.check_unknown(catalogue, archive)
    repairs = repairing.planned(catalogue, archive, findings)
    undone = [] if dry_run else repairing.apply(catalogue, archive, repairs, datetime.now(UTC))
    return Repaired(tuple(repairs), tuple(undone))


@dataclass(frozen=True)
class Removed:
    """Results, and frames of recordings in this host's spool, that were removed, or would be."""

    files: tuple[Removable, ...]
    frames: tuple[LeftFrames, ...]

    @property
    def size_bytes(self) -> int:
        """Of all of them."""
        return sum(g.size_bytes for g in self.files) + sum(f.size_bytes for f in self.frames)


@use_case(Right.ADMINISTER)
def remove_old(
    services: Services, age: timedelta, kinds: Sequence[str] = (), *, dry_run: bool = True
) -> Removed:
    """Remove old results that newer ones have replaced, and frames that old recordings have left.

    Parameters
    ----------
    age
        Only what is older.
    kinds
        Only results of these; all if it is empty.
    dry_run
        Only say what would go.

    Raises `NotFound` where there is no such kind.
    """
    names, now = [kind_named(name).name for name in kinds], datetime.now(UTC)
    spool = services.settings.spool_folder
    if dry_run:
        with services.catalogue.reading() as session:
            gone = retention.removable(session, now, age, names)
            frames = left_frames.removable(session, spool, now, age, names)
    else:
        gone = retention.remove(services.catalogue, services.archive, now, age, names)
        frames = left_frames.remove(services.catalogue, spool, now, age, names)
    return Removed(tuple(gone), tuple(frames))
