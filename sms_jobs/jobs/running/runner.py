"""Runs one job: loads what it needs, calls its kind, seals and indexes what comes out.

The only place where kinds, archive and catalogue meet. Whatever happens, the job's row tells it: done,
failed with a reason, queued again after a passing fault, or lost because a newer attempt has started. A
catalogue that is away is waited for, and an archive that cannot be used is no fault of the job.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy.orm import Session

import sms_jobs
from sms_jobs.archive import Archive, InputReference, Provenance, layout
from sms_jobs.archive.place import fault_of_the_place
from sms_jobs.catalogue.campaigns import Definitions
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import (
    Cancelled,
    CommitInDoubt,
    InstrumentError,
    LeaseLost,
    OverLimit,
    ServerUnreachable,
    SmsError,
    StorageFull,
    StorageUnusable,
)
from sms_jobs.jobs.archiving import indexing
from sms_jobs.jobs.archiving.importing import add_states
from sms_jobs.jobs.archiving.indexing import Entry
from sms_jobs.jobs.archiving.repository import Repository, operator
from sms_jobs.jobs.devices.stations import Stations
from sms_jobs.jobs.results import newer, reuse
from sms_jobs.jobs.results.reuse import Earlier
from sms_jobs.jobs.running import alike, lifecycle, outages, queues, recovery
from sms_jobs.jobs.running.empty_results import told_of_empty
from sms_jobs.jobs.running.lifecycle import Claim
from sms_jobs.jobs.running.logs import logged
from sms_jobs.jobs.running.progress import ThrottledProgress
from sms_jobs.kinds import kind_named
from sms_jobs.kinds.kind import DatasetOutput, Inputs, Kind, Output, Station
from sms_jobs.records.job import SHORT_ID, JobState
from sms_jobs.records.remarks import remarked
from sms_jobs.records.subject import Subject

T = TypeVar("T")

_ATTEMPTS = 3
"""How often a job is tried when what fails may pass by itself."""
_READ_AT_ONCE_BYTES = 1 << 20
"""An earlier result of so much is read while the catalogue waits: that takes less than a commit."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Runner:
    """Claims and runs jobs in this process.

    Attributes
    ----------
    catalogue, archive
        Where jobs come from and outputs go.
    queues
        Whose jobs it takes; may say that of every rig.
    worker_id, host
        Of the supervisor that looks after this process.
    threads
        Threads that a job may use.
    log_folder
        Of the jobs' log files.
    stations
        The rigs that are connected to this host.
    now
        Clock, with time zone.
    least_room_mb
        No job is started with less room than this on the archive's disk.
    """

    catalogue: Catalogue
    archive: Archive
    queues: Sequence[str]
    worker_id: str
    host: str
    threads: int
    log_folder: Path
    stations: Stations
    now: Callable[[], datetime]
    least_room_mb: float
    _definitions: Definitions = field(default_factory=Definitions, init=False, repr=False)

    @property
    def _repository(self) -> Repository:
        return Repository(self.catalogue, self.archive)

    def run_queued(self) -> None:
        """Run queued jobs, the first of them first, until there are none.

        The transaction that ends a job claims the next: a commit is a good part of what a job costs. With
        too little room for a job, none is started and all queues are held back; where the archive cannot be
        used, this worker is.
        """
        held = self._claimed()
        while held is not None:
            with logged(self.log_folder, held.job_id):
                logger.info("job %s: %s %s, attempt %d", held.job_id, held.kind, held.subject, held.attempt)
                held = self._run_to_end(held)

    def _claimed(self) -> Claim | None:
        """Claim a job; None when there is none, or nobody can be asked: this process is woken again."""
        fault = self._fault_beforehand()
        try:
            with self.catalogue.writing() as session:
                return self._claim(session, fault)
        except CommitInDoubt:
            return outages.outlast(
                self.catalogue, partial(self._claim, fault=fault), partial(self._settle, None), in_doubt=True
            )
        except (ServerUnreachable, StorageFull) as error:
            logger.warning("no job can be claimed: %s", error)
            return None

    def _fault_beforehand(self) -> SmsError | None:
        """Return why no job should start; called outside transactions, since a share may not answer."""
        try:
            self.archive.require_usable(self.least_room_mb)
        except (StorageFull, StorageUnusable) as fault:
            return fault
        return None

    def _claim(self, session: Session, fault: SmsError | None) -> Claim | None:
        if fault is not None:
            self._hold_back(session, fault, None)
            return None
        queues = self.stations.served(self.queues)
        return lifecycle.claim(session, queues, self.worker_id, os.getpid(), self.now())

    def _commit(self, held: Claim, step: Callable[[Session], T]) -> T:
        """Commit a step of a job to the catalogue, waiting as long as the catalogue is away."""
        return outages.outlast(self.catalogue, step, partial(self._settle, held))

    def _settle(self, held: Claim | None, session: Session) -> None:
        for job_id in lifecycle.give_back(session, self.worker_id, os.getpid(), held, self.now()):
            logger.warning("job %s: was claimed without being heard of, and is given back", job_id)

    def _run_to_end(self, held: Claim) -> Claim | None:
        """Run a job, tell how it ended, and return the next one."""
        try:
            return self._run(held)
        except LeaseLost as error:
            logger.warning("job %s: %s", held.job_id, error)
        except OverLimit as error:
            self._end(held, JobState.FAILED, str(error), error=str(error))
        except Cancelled as error:
            self._end(held, JobState.CANCELLED, f"{error} while it ran")
        except Exception as error:  # noqa: BLE001 - a kind may raise anything; the job's row must tell it
            self._fail(held, fault_of_the_place(error))
        return self._claimed()

    def _run(self, held: Claim) -> Claim | None:
        kind = kind_named(held.kind)
        fault = self._fault_beforehand()

        def begin(session: Session) -> _Begun:
            # Looked up and, if there is one, reused in one transaction: with most of what such a job costs.
            task = self._load(session, kind, held)
            hashes = {i.role: i.content_hash for i in task.inputs}
            key = reuse.reuse_key(kind, held.subject, held.parameters, task.context, hashes)
            earlier = reuse.earlier_success(session, key) if held.use_cache and held.repeatable else None
            begun = _Begun(task, key, earlier)
            if earlier is None:
                return self._take_up(session, held, begun, fault)
            if newer.replaced(session, [earlier.job_id]):
                objection = "other results have come since, and the newest counts"
            elif earlier.size_bytes > _READ_AT_ONCE_BYTES:
                return begun
            else:
                objection = reuse.damage(self.archive, earlier)
            if objection:
                return self._take_up(session, held, replace(begun, objection=objection), fault)
            return replace(begun, ended=(self._reuse(session, held, key, earlier, fault),))

        begun = self._commit(held, begin)
        if begun.earlier is not None and begun.objection is None and not begun.ended:
            begun = self._read_earlier(held, begun, begun.earlier, fault)
        if begun.ended:
            return begun.ended[0]
        task, because = begun.task, ""
        if begun.earlier is not None:
            because = f"; not reused from job {begun.earlier.job_id[:8]}: {begun.objection}"
            logger.warning("job %s is computed again%s", held.job_id, because)
        if held.attempt > 1 and (held.repeatable or kind.with_instruments):
            self._clear_leftovers(held)
        started = time.monotonic()
        sealed: list[Entry] = []
        progress = ThrottledProgress(self.catalogue, held)
        try:
            sealed.extend(self._sealed_outputs(kind, held, task, progress))
            if kind.adds_states:
                self._add_states(held, sealed)
        except BaseException:
            self._discard(held, kind, sealed)
            raise
        took = f"took {time.monotonic() - started:.1f} s{because}"
        empty = told_of_empty(one.provenance.statistics for one in sealed)
        message = "; ".join(filter(None, (took, empty, progress.closing)))
        return self._succeed(held, kind, sealed, begun.key, message)

    def _take_up(self, session: Session, held: Claim, begun: _Begun, fault: SmsError | None) -> _Begun:
        """Begin a job, or queue it again while another computes the same."""
        if not held.repeatable:
            return begun
        other = alike.take(session, held.job_id, held.fence, begun.key, giving_way=held.use_cache)
        if other is None:
            return begun
        message = f"job {other[:SHORT_ID]} computes the same, and its result is waited for"
        as_before: dict[str, Any] = {"attempts": held.attempt - 1, "reuse_key": begun.key}
        if not lifecycle.change(
            session, held.job_id, JobState.QUEUED, self.now(), message, fence=held.fence, **as_before
        ):
            raise LeaseLost("a newer attempt has started")
        logger.info("job %s: %s", held.job_id, message)
        return replace(begun, ended=(self._claim(session, fault),))

    def _add_states(self, held: Claim, sealed: Sequence[Entry]) -> None:
        """Give the campaign the states that results are about.

        Where the process ends before these are entered, they are states without a measurement until the next
        attempt finds them there.
        """
        labels = dict.fromkeys(entry.provenance.subject.state or "" for entry in sealed)
        add_states(self.catalogue, self.archive, held.subject.campaign, tuple(labels), self.now())

    def _read_earlier(self, held: Claim, begun: _Begun, earlier: Earlier, fault: SmsError | None) -> _Begun:
        """Read a large result while others use the catalogue, and reuse it if it is whole."""
        objection = reuse.damage(self.archive, earlier)

        def end(session: Session) -> _Begun:
            why = objection
            if not why and reuse.earlier_success(session, begun.key) != earlier:
                why = "its files were removed meanwhile"
            if why:
                return self._take_up(session, held, replace(begun, objection=why), fault)
            return replace(begun, ended=(self._reuse(session, held, begun.key, earlier, fault),))

        return self._commit(held, end)

    def _succeed(
        self, held: Claim, kind: Kind[Any], sealed: Sequence[Entry], key: str, message: str
    ) -> Claim | None:
        """End a job well, enter what it made into the catalogue, and return the next job."""
        fault = self._fault_beforehand()

        def end(session: Session) -> tuple[bool, Claim | None]:
            done = lifecycle.succeed(session, held, self.now(), message, reuse_key=key)
            if done:
                now = self.now()
                for entry in sealed:
                    indexing.index(session, entry, now)
            else:
                done = lifecycle.has_succeeded(session, held)  # committed before; the answer was lost
            return done, self._claim(session, fault) if done else None

        # Where the process ends before this is committed, the next attempt clears away the files.
        done, following = self._commit(held, end)
        if not done:
            self._discard(held, kind, sealed)
            raise LeaseLost("a newer attempt has started; what this one made is discarded")
        # Nothing may fail any more: the following job is this process's already.
        if kind.with_instruments:
            self.stations.empty(held.job_id)
        logger.info("job %s: done, %d files", held.job_id, len(sealed))
        return following

    def _discard(self, held: Claim, kind: Kind[Any], sealed: Sequence[Entry]) -> None:
        # What was measured and cannot be measured again is kept for the operator; with instruments, the
        # frames themselves are.
        if held.repeatable or kind.with_instruments:
            # What stays, the next attempt clears away.
            self._repository.discard(sealed)

    def _load(self, session: Session, kind: Kind[Any], held: Claim) -> _Task:
        definition = self._definitions.get(session, held.campaign_id, held.definition_hash)
        inputs = indexing.resolve_inputs(session, held.job_id, self.now())
        station = self.stations.station(definition.rig, held.job_id) if kind.with_instruments else None
        context = kind.context(definition, held.subject)
        return _Task(inputs, context, kind.parameters(**held.parameters), station)

    def _reuse(
        self, session: Session, held: Claim, key: str, earlier: Earlier, fault: SmsError | None
    ) -> Claim | None:
        """End a job with the result of an earlier one, and return the next job."""
        message = remarked(earlier.remarks, beside=f"reused from job {earlier.job_id[:8]}")
        done = lifecycle.succeed(
            session, held, self.now(), message, reuse_key=key, reused_from=earlier.job_id
        )
        if not done and not lifecycle.has_succeeded(session, held):
            raise LeaseLost("a newer attempt has started")
        logger.info("job %s: %s", held.job_id, message)
        return self._claim(session, fault)

    def _clear_leftovers(self, held: Claim) -> None:
        with self.catalogue.reading() as session:
            indexed = indexing.paths_of(session, held.job_id)
        for path in self.archive.leftovers(held.job_id, held.subject):
            # One that was given up and does not know it must not take away what a newer one writes.
            if path not in indexed and layout.attempt_of(path, held.job_id) < held.attempt:
                logger.warning("job %s: discarding %s of an earlier attempt", held.job_id, path)
                self._repository.withdraw(path)

    def _sealed_outputs(
        self, kind: Kind[Any], held: Claim, task: _Task, progress: ThrottledProgress
    ) -> Iterator[Entry]:
        with ExitStack() as stack:
            datasets = {i.role: stack.enter_context(self.archive.open(i)) for i in task.inputs}
            inputs = Inputs(held.subject, task.context, datasets, self.threads, task.station)
            for output in map(kind.checked, kind.run(inputs, task.parameters, progress)):
                yield self._seal(output, held, task)

    def _seal(self, output: Output, held: Claim, task: _Task) -> Entry:
        provenance = Provenance(
            kind=held.kind,
            kind_version=kind_named(held.kind).version,
            subject=output.subject,
            job_id=held.job_id,
            attempt=held.attempt,
            created_at=self.now(),
            parameters=task.parameters.model_dump(mode="json"),
            inputs=tuple(InputReference(i.role, i.source, i.path, i.content_hash) for i in task.inputs),
            program_version=sms_jobs.__version__,
            host=self.host,
            operator=operator(),
        )
        if isinstance(output, DatasetOutput):
            numbers = {n: float(v) for n, v in output.statistics.items() if isfinite(v)}
            return self._repository.seal(output.records, replace(provenance, statistics=numbers))
        return self._repository.seal_document(output.filename, output.media_type, output.write, provenance)

    def _fail(self, held: Claim, error: BaseException) -> None:
        fault = self._fault_of_place(held) if held.repeatable else None
        if fault is not None:
            # Whatever it says it failed of: it is tried again when the archive can be used, at no cost.
            self._try_again(held, fault, "waits")
            return
        retryable = isinstance(error, SmsError) and error.retryable and held.repeatable
        if retryable and held.tries + 1 < _ATTEMPTS:
            self._try_again(held, error, "tried again", tries=held.tries + 1)
            return
        if not held.repeatable and isinstance(
            error, InstrumentError | StorageFull | StorageUnusable | OSError
        ):
            logger.error("job %s: %s; an operator is needed", held.job_id, error)
            self._end(held, JobState.NEEDS_OPERATOR, str(error), error=str(error))
            return
        if isinstance(error, SmsError):
            message = f"{error} (tried {_ATTEMPTS} times)" if retryable else str(error)
            logger.error("job %s: %s", held.job_id, error)
        else:
            message = f"{type(error).__name__}: {error}"
            logger.error("job %s: unexpected error", held.job_id, exc_info=error)
        self._end(held, JobState.FAILED, message, error=message)

    def _fault_of_place(self, held: Claim) -> SmsError | None:
        """Return what is wrong with the archive where a job's files lie, now that it has left none there."""
        fault = self._fault_beforehand()
        if fault is not None:
            return fault
        try:
            self.archive.probe(held.subject)
        except (StorageFull, StorageUnusable) as found:
            return found
        return None

    def _try_again(self, held: Claim, error: BaseException, how: str, **columns: Any) -> None:
        """Queue the job again; if the archive is at fault, hold others back until it works again."""
        if isinstance(error, StorageFull):
            how = "waits for room"
        logger.warning("job %s: %s: %s", held.job_id, how, error)

        def queue_again(session: Session) -> None:
            if isinstance(error, StorageFull) or (isinstance(error, StorageUnusable) and not columns):
                self._hold_back(session, error, held.subject)
            message = f"{how}: {error}"
            lifecycle.change(
                session, held.job_id, JobState.QUEUED, self.now(), message, fence=held.fence, **columns
            )

        self._commit(held, queue_again)

    def _hold_back(self, session: Session, fault: SmsError, at: Subject | None) -> None:
        """Begin no job until a supervisor finds the archive in order.

        A full disk is full for everybody. What else is wrong may be wrong with this host alone: others go on.
        """
        if isinstance(fault, StorageFull):
            for name in queues.queue_names(session):
                queues.pause(session, name, str(fault), self.now(), for_room=True)
        else:
            recovery.hold(session, self.worker_id, str(fault), at)

    def _end(self, held: Claim, state: JobState, message: str, **columns: Any) -> None:
        goes_on = state in (JobState.QUEUED, JobState.NEEDS_OPERATOR)
        ended: dict[str, Any] = {} if goes_on else {"finished_at": self.now()}
        self._commit(
            held,
            lambda session: lifecycle.change(
                session, held.job_id, state, self.now(), message, fence=held.fence, **ended, **columns
            ),
        )


@dataclass(frozen=True)
class _Task:
    inputs: tuple[indexing.ResolvedInput, ...]
    context: object
    parameters: Any
    station: Station | None


@dataclass(frozen=True)
class _Begun:
    """A job whose inputs are known, and what is known of an earlier result.

    Attributes
    ----------
    objection
        Why the earlier result is not reused, such as what of it is not as it was sealed; None when it was not
        read.
    ended
        The next job or None, when this one has ended with the earlier result or given way; else nothing.
    """

    task: _Task
    key: str
    earlier: Earlier | None = None
    objection: str | None = None
    ended: tuple[Claim | None, ...] = ()
