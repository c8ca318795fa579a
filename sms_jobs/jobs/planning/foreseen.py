"""Predicts which jobs will be answered by earlier results, before they run."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sqlalchemy import select
from sqlalchemy.orm import Session, aliased

from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.jobs.results.newer import replaced
from sms_jobs.jobs.results.reuse import reuse_key
from sms_jobs.kinds import all_kinds
from sms_jobs.records.job import JobState
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    from sms_jobs.jobs.planning.submission import Draft
    from sms_jobs.records.campaign import Campaign


@dataclass(frozen=True)
class _Content:
    """A dataset that a job has made: how others find it, and what is in it."""

    source: str
    state: str | None
    view: str | None
    content_hash: str

    def meets(self, source: str, subject: Subject) -> bool:
        return (
            self.source == source
            and subject.state in (None, self.state)
            and subject.view in (None, self.view)
        )


@dataclass(frozen=True)
class _Input:
    role: str
    source: str
    subject: Subject
    producer: str | None
    content_hash: str | None


@dataclass(frozen=True)
class _Candidate:
    id: str
    kind: str
    subject: str
    parameters: dict[str, object]
    campaign_id: int


def foreseen_reuse(session: Session, job_ids: Sequence[str], planned: Draft | None = None) -> set[str]:
    """Return those of some waiting or queued jobs that will be reused if nothing changes until they run.

    That is known where the contents of all inputs are: they are files of the archive, or outputs of jobs that
    are known to be reused.

    Parameters
    ----------
    planned
        Further jobs, which are not entered yet.
    """
    pending = list(_candidates(session, job_ids))
    inputs = dict(_inputs(session, [job.id for job in pending]))
    if planned is not None:
        pending += _planned_candidates(planned)
        inputs |= _planned_inputs(session, planned)
    made = _made(session, _done_producers(session, inputs))
    definitions: dict[int, Campaign] = {}
    foreseen: set[str] = set()
    while pending:
        # All whose inputs are known now, so that the catalogue is asked once for all of them.
        keys = {}
        for job in pending:
            hashes = _hashes(inputs.get(job.id, ()), made)
            if hashes is not None:
                keys[job.id] = _key(session, job, hashes, definitions)
        earlier = _earlier(session, set(keys.values()))
        contents = _made(session, {job_id: job_id for job_id in earlier.values()})
        reused = {job_id: contents[earlier[key]] for job_id, key in keys.items() if key in earlier}
        if not reused:
            break
        made |= reused
        foreseen |= reused.keys()
        pending = [job for job in pending if job.id not in keys]
    return foreseen


def _candidates(session: Session, job_ids: Sequence[str]) -> Iterator[_Candidate]:
    """Return the jobs that a job of the same kind and subject went before with success."""
    earlier = aliased(JobRow)
    for some in parts(job_ids):
        done = (
            select(earlier.id)
            .where(
                earlier.subject == JobRow.subject,
                earlier.kind == JobRow.kind,
                earlier.state == JobState.SUCCEEDED,
                earlier.reused_from.is_(None),
            )
            .exists()
        )
        rows = session.execute(
            select(JobRow.id, JobRow.kind, JobRow.subject, JobRow.parameters, JobRow.campaign_id).where(
                JobRow.id.in_(some),
                JobRow.use_cache,
                JobRow.repeatable,
                JobRow.state.in_((JobState.WAITING, JobState.QUEUED)),
                done,
            )
        )
        yield from (_Candidate(*row) for row in rows if row.kind in all_kinds())


def _planned_candidates(planned: Draft) -> Iterator[_Candidate]:
    for row in planned.of(JobRow):
        if row["use_cache"] and row["repeatable"]:
            yield _Candidate(row["id"], row["kind"], row["subject"], row["parameters"], planned.campaign_id)


def _planned_inputs(session: Session, planned: Draft) -> Mapping[str, list[_Input]]:
    edges = planned.of(DependencyRow)
    contents: dict[int, str] = {}
    for some in parts(sorted({edge["file_id"] for edge in edges if edge["file_id"] is not None})):
        rows = session.execute(select(FileRow.id, FileRow.content_hash).where(FileRow.id.in_(some)))
        contents |= dict(rows.all())
    found: dict[str, list[_Input]] = defaultdict(list)
    for edge in edges:
        found[edge["job_id"]].append(
            _Input(
                edge["role"],
                edge["source"],
                Subject.parse(edge["subject"]),
                edge["producer_id"],
                contents.get(edge["file_id"]),
            )
        )
    return found


def _inputs(session: Session, job_ids: Sequence[str]) -> Mapping[str, list[_Input]]:
    found: dict[str, list[_Input]] = defaultdict(list)
    for some in parts(job_ids):
        rows = session.execute(
            select(
                DependencyRow.job_id,
                DependencyRow.role,
                DependencyRow.source,
                DependencyRow.subject,
                DependencyRow.producer_id,
                FileRow.content_hash,
            )
            .outerjoin(FileRow, FileRow.id == DependencyRow.file_id)
            .where(DependencyRow.job_id.in_(some))
        )
        for job_id, role, source, subject, producer, content in rows:
            found[job_id].append(_Input(role, source, Subject.parse(subject), producer, content))
    return found


def _done_producers(session: Session, inputs: Mapping[str, Iterable[_Input]]) -> dict[str, str]:
    """Return the producers that have succeeded, and the jobs that made their files."""
    named = {i.producer for some in inputs.values() for i in some if i.producer and i.content_hash is None}
    found: dict[str, str] = {}
    for some in parts(sorted(named)):
        rows = session.execute(
            select(JobRow.id, JobRow.reused_from).where(
                JobRow.id.in_(some), JobRow.state == JobState.SUCCEEDED
            )
        )
        found |= {job_id: reused_from or job_id for job_id, reused_from in rows}
    return found


def _made(session: Session, makers: Mapping[str, str]) -> dict[str, tuple[_Content, ...]]:
    """Return the datasets of some jobs, each under the name of whoever counts as having made them."""
    files: dict[str, list[_Content]] = defaultdict(list)
    for some in parts(sorted(set(makers.values()))):
        rows = session.execute(
            select(FileRow.job_id, FileRow.source, LoadStateRow.label, FileRow.view, FileRow.content_hash)
            .outerjoin(LoadStateRow, LoadStateRow.id == FileRow.state_id)
            .where(FileRow.job_id.in_(some), FileRow.media_type == DATASET_MEDIA_TYPE)
            .order_by(FileRow.id.desc())
        )
        for job_id, source, state, view, content in rows:
            files[job_id or ""].append(_Content(source, state, view, content))
    return {name: tuple(files[job_id]) for name, job_id in makers.items()}


def _hashes(inputs: Iterable[_Input], made: Mapping[str, Sequence[_Content]]) -> dict[str, str] | None:
    """Return the content hashes of a job's inputs by role; None where one is not known yet."""
    hashes = {}
    for given in inputs:
        content_hash = given.content_hash
        if content_hash is None:
            outputs = made.get(given.producer or "", ())
            content_hash = next(
                (o.content_hash for o in outputs if o.meets(given.source, given.subject)), None
            )
        if content_hash is None:
            return None
        hashes[given.role] = content_hash
    return hashes


def _key(
    session: Session, job: _Candidate, hashes: Mapping[str, str], definitions: dict[int, Campaign]
) -> str:
    if job.campaign_id not in definitions:
        definitions[job.campaign_id] = campaigns.definition(session.get_one(CampaignRow, job.campaign_id))
    kind, subject = all_kinds()[job.kind], Subject.parse(job.subject)
    context = kind.context(definitions[job.campaign_id], subject)
    return reuse_key(kind, subject, job.parameters, context, hashes)


def _earlier(session: Session, keys: Collection[str]) -> dict[str, str]:
    """Return the newest success of each reuse key that has one."""
    found: dict[str, str] = {}
    for some in parts(sorted(keys)):
        rows = session.execute(
            select(JobRow.reuse_key, JobRow.id)
            .where(
                JobRow.reuse_key.in_(some),
                JobRow.state == JobState.SUCCEEDED,
                JobRow.reused_from.is_(None),
                JobRow.repeatable,
            )
            .order_by(JobRow.finished_at)
        )
        found |= {key or "": job_id for key, job_id in rows}
    passed = replaced(session, found.values())
    return {key: job_id for key, job_id in found.items() if job_id not in passed}
