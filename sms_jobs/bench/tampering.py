"""A small campaign in an archive, and what becomes of it when bits flip and files are exchanged.

Run as `python -m sms_jobs.bench.tampering FOLDER MODE FIRST LAST`, it makes those tries one after the other
and prints a line for each. Mode `reads` opens files as jobs and commands do and reads all of them; `jobs`
has real jobs run. A process of its own: damage in a few places makes HDF5 spin for ever.
"""

from __future__ import annotations

import hashlib
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive, FolderStore, layout
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.errors import ArchiveCorrupt, OtherFormat, SmsError
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.devices.stations import Stations
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.jobs.results import reuse
from sms_jobs.jobs.results.reuse import Earlier, EarlierFile
from sms_jobs.jobs.running import recovery
from sms_jobs.jobs.running.runner import Runner
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.job import JobState
from sms_jobs.records.sensors import Calibration
from sms_jobs.virtual_rig.campaigns import small_plate

_TRIED = ("reconstruct", "correlate", "strain")
_CPU_S = {"reads": 5.0, "jobs": 120.0}
_EXCHANGED = 0.15
_IN_A_TEXT = 0.25
_TEXT = b'{"'


def prepare(folder: Path) -> None:
    """Run every kind of job for two states of a small plate."""
    archive = Archive(FolderStore(folder / "archive"))
    with closing(Catalogue(url(folder), create=True)) as catalogue:
        campaign = registered(catalogue, archive, *small_plate("plate"))
        with catalogue.writing() as session:
            submit(session, campaign.name, [Request("simulate"), Request("pipeline")], now())
        runner(folder, catalogue, archive).run_queued()
        with catalogue.reading() as session:
            unwell = session.scalars(select(JobRow.kind).where(JobRow.state != JobState.SUCCEEDED)).all()
    if unwell:
        raise SmsError(f"{len(unwell)} jobs did not succeed on what is whole, {unwell[0]} first; report it")


def registered(
    catalogue: Catalogue, archive: Archive, calibration: Calibration, campaign: Campaign
) -> Campaign:
    """Make a catalogue with the first view and the first two states of a campaign, and a worker `bench`."""
    schema.upgrade(catalogue)
    campaign = replace(campaign, states=campaign.states[:2], views=campaign.views[:1])
    register_campaign(catalogue, archive, campaign, calibration, now())
    with catalogue.writing() as session:
        recovery.register_worker(session, "bench", "here", 1, ["cpu", "io", "acquisition"], 1, now())
    return campaign


def tried(folder: Path, mode: str, count: int) -> Iterator[str]:
    """Make tries and yield what became of each.

    noticed: it was refused, or computed again. same: what came of it is what was sealed, since the bit lies
    where nothing is read. changed: other values came of it. unclear: a job failed without naming the file.
    ended: HDF5 never came back, and the process was ended.
    """
    done = 0
    while done < count:
        command = [sys.executable, "-P", "-m", __name__, str(folder), mode, str(done), str(count)]
        process = subprocess.run(command, capture_output=True, text=True, check=False)
        lines = process.stdout.split()
        yield from lines
        done += len(lines)
        if done < count:
            if process.returncode != -signal.SIGPROF and process.returncode != -signal.SIGSEGV:
                raise SmsError(f"try {done} of {mode} ended unexpectedly: {process.stderr[-500:]}")
            yield "ended"
            done += 1


def main(folder: Path, mode: str, first: int, last: int) -> None:
    """Make some tries and print what became of each."""
    archive = Archive(FolderStore(folder / "archive"))
    with closing(Catalogue(url(folder))) as catalogue:
        with catalogue.reading() as session:
            files = list(session.scalars(select(FileRow).order_by(FileRow.id)))
        _restore_left(archive, folder)
        work = _Reads(archive, files) if mode == "reads" else _Jobs(folder, catalogue, archive)
        for number in range(first, last):
            random = np.random.default_rng([number, len(mode)])
            signal.setitimer(signal.ITIMER_PROF, _CPU_S[mode])
            outcome = work.outcome(random, folder)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            sys.stdout.write(f"{outcome}\n")
            sys.stdout.flush()


class _Reads:
    """Tries on single files: read as a job reads an input, and as an earlier result that could be reused."""

    def __init__(self, archive: Archive, files: Sequence[FileRow]) -> None:
        self._archive, self._files = archive, files
        self._good = {file.path: _values(archive, file) for file in files}

    def outcome(self, random: np.random.Generator, folder: Path) -> str:
        file = self._files[int(random.integers(len(self._files)))]
        with _tampered(self._archive, folder, file, self._files, random):
            earlier = Earlier("", (EarlierFile(file.path, file.content_hash, file.size_bytes, file.sha256),))
            if not reuse.damage(self._archive, earlier):
                return "changed"
            try:
                return "same" if _values(self._archive, file) == self._good[file.path] else "changed"
            except (ArchiveCorrupt, OtherFormat):
                return "noticed"


class _Jobs:
    """Tries with jobs: one of their inputs is altered, or the result that they would be answered with."""

    def __init__(self, folder: Path, catalogue: Catalogue, archive: Archive) -> None:
        self._folder, self._catalogue, self._archive = folder, catalogue, archive
        self._runner = runner(folder, catalogue, archive)

    def outcome(self, random: np.random.Generator, folder: Path) -> str:
        kind, of_result = str(random.choice(_TRIED)), bool(random.random() < 0.3)
        with self._catalogue.writing() as session:
            files = list(session.scalars(select(FileRow).order_by(FileRow.id)))
            request = Request(kind, states=("S01",))
            (job,) = submit(session, "plate", [request], now(), Terms(use_cache=of_result)).job_ids
            earlier = _newest(session, kind)
            given = select(DependencyRow.file_id).where(DependencyRow.job_id == job)
            inputs = [file for file in files if file.id in set(session.scalars(given))]
        victim = earlier if of_result else inputs[int(random.integers(len(inputs)))]
        with _tampered(self._archive, folder, victim, files, random):
            self._runner.run_queued()
        with self._catalogue.reading() as session:
            row = session.get_one(JobRow, job)
            if row.state is JobState.FAILED:
                return "noticed" if victim.path in (row.error or "") else "unclear"
            if row.state is not JobState.SUCCEEDED or row.reused_from is not None:
                return "changed"
            same = _newest(session, kind).content_hash == earlier.content_hash
        return "changed" if not same else "noticed" if of_result else "same"


def _newest(session: Session, kind: str) -> FileRow:
    query = select(FileRow).where(FileRow.source == kind, FileRow.path.contains("/S01/"))
    return session.scalars(query.order_by(FileRow.id.desc()).limit(1)).one()


def _lying(archive: Archive, path: str) -> Path:
    """Return the file itself, behind the archive's back."""
    assert isinstance(archive.store, FolderStore)
    return archive.store.path(path)


@contextmanager
def _tampered(
    archive: Archive, folder: Path, file: FileRow, files: Sequence[FileRow], random: np.random.Generator
) -> Iterator[None]:
    """Alter a file for a while: another of its sort in its place, or a bit anywhere or in a text."""
    path = _lying(archive, file.path)
    good = path.read_bytes()
    (folder / "left").write_text(file.path, encoding="utf-8")
    (folder / "left.bytes").write_bytes(good)
    path.chmod(0o644)
    path.write_bytes(_altered(archive, file, files, good, random))
    try:
        yield
    finally:
        path.write_bytes(good)
        (folder / "left").unlink()


def _altered(
    archive: Archive, file: FileRow, files: Sequence[FileRow], good: bytes, random: np.random.Generator
) -> bytes:
    alike = [
        other
        for other in files
        if layout.is_dataset(other.path) == layout.is_dataset(file.path)
        and other.content_hash != file.content_hash
    ]
    how = random.random()
    if how < _EXCHANGED and alike:
        return _lying(archive, alike[int(random.integers(len(alike)))].path).read_bytes()
    place, until = 0, len(good)
    if how < _EXCHANGED + _IN_A_TEXT:
        texts = [at for at in range(len(good)) if good.startswith(_TEXT, at)][:50] or [0]
        place = texts[int(random.integers(len(texts)))]
        until = min(place + 500, len(good))
    byte = int(random.integers(place, until))
    return good[:byte] + bytes([good[byte] ^ (1 << int(random.integers(8)))]) + good[byte + 1 :]


def _restore_left(archive: Archive, folder: Path) -> None:
    """Put back the file that a process which was ended left altered."""
    left = folder / "left"
    if left.is_file():
        _lying(archive, left.read_text(encoding="utf-8")).write_bytes((folder / "left.bytes").read_bytes())
        left.unlink()


def _values(archive: Archive, file: FileRow) -> str:
    """Return a digest of all that is read of a file."""
    if not layout.is_dataset(file.path):
        archive.verify(file.path, file.content_hash)
        return file.content_hash
    digest = hashlib.sha256()
    with archive.open(file) as dataset:
        for name in dataset.names:
            _add(digest, dataset.read(name, dataset.record_class(name)))
    return digest.hexdigest()


def _add(digest: Any, record: Any) -> None:
    for field in fields(record):
        value = getattr(record, field.name)
        if hasattr(value, "rows") and hasattr(value, "frame"):
            value = value.rows(0, value.shape[1])
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())


def runner(folder: Path, catalogue: Catalogue, archive: Archive) -> Runner:
    """Return what runs jobs in this process."""
    return Runner(
        catalogue,
        archive,
        ["cpu", "io", "acquisition"],
        "bench",
        "here",
        1,
        folder / "logs",
        Stations(folder / "rigs", folder / "spool"),
        now,
        least_room_mb=0.0,
    )


def url(folder: Path) -> str:
    """Return where the catalogue of a folder lies."""
    return f"sqlite:///{folder / 'catalogue.sqlite'}"


def now() -> datetime:
    """Return the time, with time zone."""
    return datetime.now(UTC)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
