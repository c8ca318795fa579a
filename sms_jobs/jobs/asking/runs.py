"""Named runs: which results belong together, because one name was given to what asked for them.

A run names jobs, and by them the results that these made or were answered with; it copies nothing. Of
several jobs of one kind and subject the newest that succeeded counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

from sqlalchemy import Select, delete, func, insert, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.calibrations import CalibrationUseRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow, ProvenanceRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.runs import RunJobRow, RunRow, RunSubmissionRow
from sms_jobs.errors import Conflict, NotFound
from sms_jobs.formats.importers.folders import natural
from sms_jobs.records.job import ACTIVE, JobState
from sms_jobs.records.shown.runs import RunResult, RunStory, RunView
from sms_jobs.records.sizes import number_of

if TYPE_CHECKING:
    from sms_jobs.jobs.planning.submission import Submission


_MOST_NAMED = 20


@dataclass(frozen=True)
class ResultInput:
    """An input of a result: its file, what that holds, and the job that made it."""

    file_id: int
    source: str
    content_hash: str
    job_id: str | None


@dataclass(frozen=True)
class Member:
    """A result of a run, with all that tells it from another.

    Attributes
    ----------
    result
        As it is shown.
    reuse_key
        Of its job; None where its files are gone.
    contents
        Content hashes of its files, in their order.
    media_types
        Of its files.
    inputs
        By role.
    """

    result: RunResult
    reuse_key: str | None
    contents: tuple[str, ...]
    media_types: tuple[str, ...]
    inputs: Mapping[str, ResultInput]


@dataclass(frozen=True)
class Members:
    """All results of a run.

    Attributes
    ----------
    parameters
        Values of parameters that were given, by `kind.name`.
    by_subject
        By kind and subject.
    missing
        Kinds and subjects of which no job has succeeded, with the state of the newest.
    """

    parameters: Mapping[str, Any]
    by_subject: Mapping[tuple[str, str], Member]
    missing: Mapping[tuple[str, str], JobState]


def require_open(session: Session, name: str) -> None:
    """Raise `Conflict` for a run to which nothing is added any more."""
    row = _row(session, name)
    if row is not None and row.kept_at is not None:
        raise Conflict(f"run '{name}' is kept as it is, and takes no more jobs; choose another name")


def enter(
    session: Session, name: str, done: Submission, asked: Mapping[str, Any], now: datetime, by: str
) -> None:
    """Let the jobs of a submission belong to a run, in the transaction that enters them.

    Parameters
    ----------
    done
        With at least one job.
    asked
        Values of the parameters that were given, by `kind.name`.

    Raises
    ------
    Conflict
        The run is kept, and takes no more jobs.
    """
    if _row(session, name) is None:
        try:
            with session.begin_nested():
                session.add(RunRow(name=name, created_at=now, created_by=by))
        except IntegrityError:
            pass  # somebody else has started it meanwhile
    # Locked, so that it is not kept or dropped before this is committed.
    run = _required(session, name, lock=True)
    require_open(session, name)
    session.add(
        RunSubmissionRow(
            run_id=run.id,
            campaign_id=done.campaign_id,
            submitted_at=done.submitted_at,
            submitted_by=by,
            asked=dict(asked),
        )
    )
    session.flush()
    session.execute(insert(RunJobRow), [{"run_id": run.id, "job_id": job_id} for job_id in done.job_ids])


def views(session: Session) -> list[RunView]:
    """Return all runs, the newest first."""
    rows = session.scalars(select(RunRow).order_by(RunRow.created_at.desc(), RunRow.id.desc())).all()
    jobs: dict[int, dict[str, int]] = {}
    for run_id, state, count in session.execute(
        select(RunJobRow.run_id, JobRow.state, func.count())
        .join(JobRow, JobRow.id == RunJobRow.job_id)
        .group_by(RunJobRow.run_id, JobRow.state)
    ):
        jobs.setdefault(run_id, {})[state.value] = count
    submitted: dict[int, list[str]] = {}
    for run_id, campaign in session.execute(
        select(RunSubmissionRow.run_id, CampaignRow.name)
        .join(CampaignRow, CampaignRow.id == RunSubmissionRow.campaign_id)
        .order_by(RunSubmissionRow.id)
    ):
        submitted.setdefault(run_id, []).append(campaign)
    return [
        RunView(
            row.name,
            row.created_at,
            row.created_by,
            tuple(dict.fromkeys(submitted.get(row.id, ()))),
            len(submitted.get(row.id, ())),
            jobs.get(row.id, {}),
            row.kept_at,
            row.reason,
        )
        for row in rows
    ]


def view(session: Session, name: str) -> RunView:
    """Return a run; raise `NotFound`, naming those that there are."""
    _required(session, name)
    return next(one for one in views(session) if one.name == name)


def story(session: Session, name: str) -> RunStory:
    """Return a run with all that it names; raises as `view` does."""
    shown, found = view(session, name), members(session, name)
    return RunStory(
        shown,
        found.parameters,
        tuple(found.by_subject[key].result for key in sorted(found.by_subject, key=in_order)),
        {" ".join(key): found.missing[key].value for key in sorted(found.missing, key=in_order)},
    )


def in_order(about: tuple[str, str]) -> tuple[str, tuple[tuple[int, int, str], ...]]:
    """Return by what kinds and subjects are put in order: S2 before S10, and C2P1 before C10P1."""
    return about[0], natural(about[1])


def keep(session: Session, name: str, reason: str, now: datetime) -> None:
    """Let no policy remove what a run names, and add nothing to it.

    Raises
    ------
    NotFound
        There is no such run.
    Conflict
        It is kept already, or has jobs that have not ended.
    """
    row = _required(session, name, lock=True)
    if row.kept_at is not None:
        raise Conflict(f"run '{name}' is already kept; 'sms run show {name}' says why")
    active = session.scalar(
        select(func.count())
        .select_from(RunJobRow)
        .join(JobRow, JobRow.id == RunJobRow.job_id)
        .where(RunJobRow.run_id == row.id, JobRow.state.in_(ACTIVE))
    )
    if active:
        verb = "has" if active == 1 else "have"
        raise Conflict(
            f"{number_of(active, 'job')} of run '{name}' {verb} not ended; wait, or cancel what is left first"
        )
    row.kept_at, row.reason = now, reason
    # Locked, so that nobody lets them go before this is committed.
    session.scalars(_kept_files(row.id).with_for_update(read=True, key_share=True, of=FileRow)).all()


def drop(session: Session, name: str) -> None:
    """Forget a name; jobs and results stay. Raises `NotFound` where there is none of that name."""
    row = _required(session, name, lock=True)
    for table in (RunJobRow, RunSubmissionRow):
        session.execute(delete(table).where(table.run_id == row.id))
    session.delete(row)
    session.flush()


def kept_files(session: Session) -> set[int]:
    """Return the numbers of all files that runs name which are kept."""
    return set(session.scalars(_kept_files(None)))


def _kept_files(run_id: int | None) -> Select[int]:
    query = (
        select(FileRow.id)
        .join(JobRow, FileRow.job_id == func.coalesce(JobRow.reused_from, JobRow.id))
        .join(RunJobRow, RunJobRow.job_id == JobRow.id)
    )
    if run_id is not None:
        return query.where(RunJobRow.run_id == run_id)
    return query.join(RunRow, RunRow.id == RunJobRow.run_id).where(RunRow.kept_at.is_not(None))


def members(session: Session, name: str) -> Members:
    """Return all results of a run; raises as `view` does."""
    run = _required(session, name)
    given = session.scalars(
        select(RunSubmissionRow.asked).where(RunSubmissionRow.run_id == run.id).order_by(RunSubmissionRow.id)
    )
    asked = {name: value for one in given for name, value in one.items()}
    jobs = session.execute(
        select(
            JobRow.kind,
            JobRow.subject,
            JobRow.state,
            JobRow.id,
            JobRow.reused_from,
            JobRow.kind_version,
            JobRow.parameters,
            JobRow.reuse_key,
        )
        .join(RunJobRow, RunJobRow.job_id == JobRow.id)
        .where(RunJobRow.run_id == run.id)
        .order_by(JobRow.position, JobRow.id)
    ).all()
    done = {(job.kind, job.subject): job for job in jobs if job.state is JobState.SUCCEEDED}
    newest = {(job.kind, job.subject): job.state for job in jobs}
    made = _Made(session, [job.reused_from or job.id for job in done.values()])
    found = {}
    for key, job in done.items():
        files = made.files.get(job.reused_from or job.id, ())
        inputs = {role: given for file in files for role, given in made.inputs.get(file.id, {}).items()}
        numbers = {number for file in files for number in made.calibrations.get(file.id, ())}
        result = RunResult(
            job.kind,
            job.kind_version,
            job.subject,
            job.id,
            job.reused_from or job.id,
            job.parameters,
            tuple(file.id for file in files),
            {role: f"{given.source} {given.file_id}" for role, given in sorted(inputs.items())},
            tuple(sorted(numbers)),
        )
        hashes = tuple(file.content_hash for file in files)
        types = tuple(file.media_type for file in files)
        found[key] = Member(result, job.reuse_key, hashes, types, inputs)
    return Members(asked, found, {key: state for key, state in newest.items() if key not in done})


class _Made:
    """What jobs made: files by job, inputs and calibrations by file."""

    def __init__(self, session: Session, job_ids: Sequence[str]) -> None:
        self.files: dict[str, list[Any]] = {}
        self.inputs: dict[int, dict[str, ResultInput]] = {}
        self.calibrations: dict[int, list[int]] = {}
        columns = (FileRow.job_id, FileRow.id, FileRow.content_hash, FileRow.media_type)
        for some in parts(sorted(set(job_ids))):
            for file in session.execute(
                select(*columns).where(FileRow.job_id.in_(some)).order_by(FileRow.id)
            ):
                self.files.setdefault(file.job_id, []).append(file)
        numbers = [file.id for files in self.files.values() for file in files]
        for chosen in parts(numbers):
            self._load_inputs(session, chosen)
            uses = select(CalibrationUseRow.file_id, CalibrationUseRow.calibration_id)
            for file_id, number in session.execute(uses.where(CalibrationUseRow.file_id.in_(chosen))):
                self.calibrations.setdefault(file_id, []).append(number)

    def _load_inputs(self, session: Session, files: Sequence[int]) -> None:
        query = (
            select(
                ProvenanceRow.output_id,
                ProvenanceRow.role,
                FileRow.id,
                FileRow.source,
                FileRow.content_hash,
                FileRow.job_id,
            )
            .join(FileRow, FileRow.id == ProvenanceRow.input_id)
            .where(ProvenanceRow.output_id.in_(files))
        )
        for output, role, number, source, content, job_id in session.execute(query):
            self.inputs.setdefault(output, {})[role] = ResultInput(number, source, content, job_id)


def _row(session: Session, name: str) -> RunRow | None:
    return session.scalar(select(RunRow).where(RunRow.name == name))


def _required(session: Session, name: str, *, lock: bool = False) -> RunRow:
    query = select(RunRow).where(RunRow.name == name).execution_options(populate_existing=True)
    row = session.scalar(query.with_for_update() if lock else query)
    if row is None:
        names = session.scalars(
            select(RunRow.name).order_by(RunRow.created_at.desc()).limit(_MOST_NAMED)
        ).all()
        hint = (
            f"the latest are {', '.join(names)}" if names else "name one with 'sms job submit ... --run NAME'"
        )
        raise NotFound(f"there is no run '{name}'; {hint}")
    return row
