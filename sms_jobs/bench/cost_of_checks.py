"""What it costs a job to compare its inputs with what was sealed: the same job with and without, in turn.

Computing takes thirty times what comparing does, and varies by more than that from run to run: the time that
opening and reading take is counted apart from it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select

from sms_jobs.archive import Archive, FolderStore, Provenance, hdf5
from sms_jobs.archive.codec import layout_of, record_from_parts
from sms_jobs.archive.provenance import provenance_from_json
from sms_jobs.bench.tampering import now, registered, runner, url
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.archiving import indexing
from sms_jobs.jobs.archiving.indexing import ResolvedInput
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.kinds import kind_named
from sms_jobs.kinds.kind import DatasetOutput, Inputs
from sms_jobs.kinds.products import Dataset
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import FrameStack, Measurement
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject

KINDS = ("reconstruct", "correlate", "strain", "merge")
R = TypeVar("R")


@dataclass(frozen=True)
class Cost:
    """CPU-seconds of a kind of job, and of its reading with its inputs compared and as they are."""

    kind: str
    job: float
    compared: float
    uncompared: float


class _Reading:
    """Adds up the CPU-seconds of this process that go into reading."""

    def __init__(self) -> None:
        self.seconds = 0.0

    @contextmanager
    def timed(self) -> Iterator[None]:
        started = time.process_time()
        try:
            yield
        finally:
            self.seconds += time.process_time() - started


@dataclass(frozen=True)
class _TimedFrames:
    """Frames whose reading is timed."""

    frames: FrameStack
    reading: _Reading

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.frames.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.frames.dtype

    def frame(self, index: int) -> NDArray[Any]:
        with self.reading.timed():
            return self.frames.frame(index)

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        with self.reading.timed():
            return self.frames.rows(start, stop)


@dataclass(frozen=True)
class _Timed:
    """A dataset whose reading is timed."""

    dataset: Dataset
    reading: _Reading

    @property
    def subject(self) -> Subject:
        return self.dataset.subject

    @property
    def names(self) -> tuple[str, ...]:
        return self.dataset.names

    def read(self, name: str, record: type[R]) -> R:
        with self.reading.timed():
            found = self.dataset.read(name, record)
        if isinstance(found, Measurement):
            return replace(found, frames=_TimedFrames(found.frames, self.reading))
        return found


@dataclass(frozen=True)
class _Frames:
    """Frames as HDF5 reads them."""

    _dataset: Any

    @property
    def shape(self) -> tuple[int, int, int]:
        frames, rows, columns = self._dataset.shape
        return frames, rows, columns

    @property
    def dtype(self) -> np.dtype[Any]:
        dtype: np.dtype[Any] = self._dataset.dtype
        return dtype

    def frame(self, index: int) -> NDArray[Any]:
        return np.asarray(self._dataset[index])

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        return np.asarray(self._dataset[:, start:stop])


@dataclass(frozen=True)
class _Uncompared:
    """A dataset file that is opened as often as another, and whose contents are compared with nothing."""

    subject: Subject
    path: Path
    names: tuple[str, ...]
    streams: ExitStack

    def read(self, name: str, record: type[R]) -> R:
        declared = layout_of(record).arrays
        streamed = any(field.streamed for field in declared.values())
        with ExitStack() as briefly:
            file = (self.streams if streamed else briefly).enter_context(h5py.File(self.path, "r"))
            group = file["entry"][name]
            present = set(group.attrs["arrays"])
            arrays = {
                key: _Frames(group[key]) if field.streamed else group[key][...]
                for key, field in declared.items()
                if key in present
            }
            plain = hdf5.read_text(group[hdf5.FIELDS])
        return record_from_parts(record, plain, arrays, name)


@contextmanager
def _uncompared(path: Path) -> Iterator[_Uncompared]:
    with h5py.File(path, "r") as file:
        document = hdf5.read_text(file["entry"][hdf5.PROCESS]["provenance"])
        names = tuple(file["entry"].attrs["records"])
    with ExitStack() as streams:
        yield _Uncompared(provenance_from_json(document, path.name).subject, path, names, streams)


def measured(
    folder: Path, made: tuple[Calibration, Campaign], repeats: int, say: Callable[[str], None]
) -> Iterator[Cost]:
    """Run the first jobs of a pipeline, then those of one state again, in turn with and without."""
    archive = Archive(FolderStore(folder / "archive"))
    with closing(Catalogue(url(folder), create=True)) as catalogue:
        campaign = registered(catalogue, archive, *made)
        label = campaign.states[-1].label
        with catalogue.writing() as session:
            submit(session, campaign.name, [Request(kind) for kind in ("simulate", *KINDS)], now())
        runner(folder, catalogue, archive).run_queued()
        attempts = count(2)
        for kind in KINDS:
            say(f"{kind}, with comparing its inputs and without")
            with catalogue.reading() as session:
                about = JobRow.subject.contains(f"/{label}")
                job = session.scalars(select(JobRow).where(JobRow.kind == kind, about)).first()
                assert job is not None
                inputs = indexing.resolve_inputs(session, job.id, now())
                definition = campaigns.definition(campaigns.campaign_row(session, campaign.name))
            work = _Work(archive, job, inputs, definition)
            jobs: list[float] = []
            taken: dict[bool, list[float]] = {True: [], False: []}
            for turn in range(2 * repeats + 2):
                compared = turn % 2 == 0
                seconds, reading = work.seconds(compared, next(attempts))
                if turn > 1:
                    taken[compared].append(reading)
                    jobs.append(seconds - reading)
            # Whatever else the machine does only adds to what is taken.
            compared_s, uncompared_s = min(taken[True]), min(taken[False])
            yield Cost(kind, min(jobs) + uncompared_s, compared_s, uncompared_s)


@dataclass(frozen=True)
class _Work:
    """A job that has run, to be run again from the archive to the archive."""

    archive: Archive
    job: JobRow
    inputs: Sequence[ResolvedInput]
    definition: Campaign

    def seconds(self, compared: bool, attempt: int) -> tuple[float, float]:
        """Return the CPU-seconds for reading, computing and sealing, and those for reading alone."""
        kind, subject = kind_named(self.job.kind), Subject.parse(self.job.subject)
        parameters = kind.parameters(**self.job.parameters)
        made = Provenance(kind.name, 1, subject, "bench", attempt, now(), {}, (), "0", "here", "me")
        started, reading = time.process_time(), _Reading()
        with ExitStack() as stack:
            datasets: dict[str, Dataset] = {}
            for given in self.inputs:
                with reading.timed():
                    if compared:
                        opened: Dataset = stack.enter_context(self.archive.open(given))
                    else:
                        lying = stack.enter_context(self.archive.local(given.path))
                        opened = stack.enter_context(_uncompared(lying))
                datasets[given.role] = _Timed(opened, reading)
            inputs = Inputs(subject, kind.context(self.definition, subject), datasets, threads=1)
            for output in kind.run(inputs, parameters, lambda fraction, message="": None):
                if isinstance(output, DatasetOutput):
                    sealed = self.archive.seal_dataset(output.records, replace(made, subject=output.subject))
                    self.archive.discard(sealed.path)
        return time.process_time() - started, reading.seconds
