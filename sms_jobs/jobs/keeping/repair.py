"""Mends what a verification has found, as far as that can be done without a person and without any loss.

Nothing is deleted: what does not belong into the archive is moved to a folder of it where nobody looks for
results. What was measured and is damaged comes from a backup alone, and what was computed from it is
computed again by a job.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, TypeAlias

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive, Checker, layout
from sms_jobs.catalogue import campaigns, search
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.calibrations import AcceptanceRow, CalibrationRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.archiving.acceptances import decided
from sms_jobs.jobs.archiving.indexing import ACCEPTANCE, CAMPAIGN
from sms_jobs.jobs.archiving.registration import defined
from sms_jobs.jobs.archiving.repository import Repository
from sms_jobs.jobs.keeping import retention
from sms_jobs.jobs.keeping.verification import Finding, Problem
from sms_jobs.jobs.rebuilding import reindexing
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT
from sms_jobs.records.calibration import Acceptance
from sms_jobs.records.campaign import CampaignDefinition
from sms_jobs.records.subject import Subject

Step: TypeAlias = Literal["index", "set-aside", "forget", "seal-again", "nothing"]

_RESTORE = "restore it from a backup"
_UNKNOWN = ("unknown", "unfinished", "stray")


@dataclass(frozen=True)
class Repair:
    """What is done about a finding.

    Attributes
    ----------
    problem, path
        Of the finding.
    step
        index: the catalogue learns of it. set-aside: it is moved out of the way. forget: the catalogue does
        not look for it any more, since a newer result has replaced it; what is left of it is set aside.
        seal-again: the catalogue's definition of a campaign, or its decision about a calibration, is stored
        anew. nothing: a person has to.
    why
        A sentence.
    then
        What is left for a person to do; empty when nothing is.
    """

    problem: Problem
    path: str
    step: Step
    why: str
    then: str = ""


def planned(
    catalogue: Catalogue, archive: Archive, findings: Sequence[Finding], checker: Checker | None = None
) -> list[Repair]:
    """Say what would be done about some findings; nothing is changed.

    `checker` reads the files that the catalogue does not know; one of its own if not given.
    """
    unknown = {f.path for f in findings if f.problem == "unknown"}
    paths = [path for path in reindexing.unknown_files(catalogue, archive) if path in unknown]
    judged = {
        one.path: one for one in reindexing.reindex(catalogue, archive, paths, dry_run=True, checker=checker)
    }
    with catalogue.reading() as session:
        going = {one.path for one in retention.without_needed(session, retention.superseded(session))}
        repairs = [_known(session, f, going) for f in findings if f.problem not in _UNKNOWN]
        unsealed = _without_definition(session)
    repairs += [_unknown(judged[path]) for path in paths]
    repairs += [
        Repair(f.problem, f.path, "set-aside", f.detail)
        for f in findings
        if f.problem in ("unfinished", "stray")
    ]
    return [*repairs, *unsealed]


def _unknown(judged: reindexing.Reindexed) -> Repair:
    if judged.outcome in ("indexed", "incomplete"):
        return Repair(
            "unknown", judged.path, "index", judged.detail or "it is whole and says where it is from"
        )
    if judged.outcome == "refused":
        return Repair("unknown", judged.path, "set-aside", judged.detail)
    return Repair("unknown", judged.path, "nothing", judged.detail, "see what it says")


def _known(session: Session, finding: Finding, going: set[str]) -> Repair:
    problem, path = finding.problem, finding.path
    if problem == "too-new":
        return Repair(problem, path, "nothing", finding.detail, "install a newer sms_jobs")
    file = session.scalars(select(FileRow).where(FileRow.path == path)).one()
    if file.source == CAMPAIGN:
        return Repair(problem, path, "seal-again", "the catalogue has what it said")
    if file.source == ACCEPTANCE:
        if _decision(session, path) is None:
            return Repair(problem, path, "forget", "it was decided otherwise since")
        return Repair(problem, path, "seal-again", "the catalogue has what was decided")
    if path in going:
        return Repair(problem, path, "forget", "a newer result has replaced it and nothing needs it")
    again = _command(session, file)
    if file.source in (MEASUREMENT, CALIBRATION) or again is None:
        what = "calibrations are" if file.source == CALIBRATION else "what was measured is"
        advice = _RESTORE if again is None else f"{_RESTORE}, or simulate it again: {again}"
        return Repair(problem, path, "nothing", f"{what} in no other place", advice)
    if problem == "missing":
        return Repair(problem, path, "nothing", "it can be computed again", again)
    return Repair(problem, path, "set-aside", "so that no job is given it", again)


def _command(session: Session, file: FileRow) -> str | None:
    """Return the command that makes a file once more; None where no job does, or must not by itself."""
    job = None if file.job_id is None else session.get(JobRow, file.job_id)
    if job is None or not job.repeatable or job.kind not in all_kinds():
        return None
    kind = all_kinds()[job.kind]
    about = Subject.parse(job.subject)
    words = ["sms job submit", job.kind, "-c", about.campaign]
    for option, name in (("--state", about.state), ("--view", about.view)):
        words += [] if name is None else [option, name]
    processing = campaigns.definition(campaigns.campaign_row(session, about.campaign)).processing
    default = kind.parameters.model_validate(processing.get(job.kind, {})).model_dump(mode="json")
    for name, value in job.parameters.items():
        if value != default.get(name):
            words += ["--set", f"{name}={value}"]
    return " ".join(words)


def _without_definition(session: Session) -> list[Repair]:
    """Name the campaigns whose definition no file of the archive tells: those of older versions."""
    query = select(CampaignRow.name).where(
        ~select(FileRow.id).where(FileRow.campaign_id == CampaignRow.id, FileRow.source == CAMPAIGN).exists()
    )
    return [
        Repair("missing", f"{name}/", "seal-again", "the archive does not say what this campaign is")
        for name in session.scalars(query.order_by(CampaignRow.id))
    ]


def apply(
    catalogue: Catalogue,
    archive: Archive,
    repairs: Sequence[Repair],
    now: datetime,
    checker: Checker | None = None,
) -> list[Repair]:
    """Do what was planned; return what could not be done, with the reason.

    Files are moved before the catalogue forgets them: killed in between, they are missing and no more.
    """
    to_index = [one.path for one in repairs if one.step == "index"]
    undone = [
        Repair("unknown", result.path, "nothing", result.detail, "run 'sms archive repair' again")
        for result in reindexing.reindex(catalogue, archive, to_index, checker=checker)
        if not result.entered
    ]
    for one in repairs:
        if one.step in ("set-aside", "forget"):
            archive.set_aside(one.path)
        if one.step == "forget":
            with catalogue.writing() as session:
                file = session.scalar(select(FileRow.id).where(FileRow.path == one.path))
                retention.forget(session, [] if file is None else [file])
        if one.step == "seal-again":
            if layout.is_decision(one.path):
                _decide_again(catalogue, archive, one.path)
            else:
                _seal_again(catalogue, archive, one.path, now)
    return undone


def _seal_again(catalogue: Catalogue, archive: Archive, path: str, now: datetime) -> None:
    name = layout.campaign_of(path)
    with catalogue.reading() as session:
        row = campaigns.campaign_row(session, name)
        definition = CampaignDefinition(campaigns.definition(row), row.plan)
    if not path.endswith("/") and archive.has(path):
        archive.set_aside(path)

    def forget(session: Session) -> None:
        old = session.scalar(select(FileRow.id).where(FileRow.path == path))
        retention.forget(session, [] if old is None else [old])

    # With the time at which the campaign was registered, which a rebuilt catalogue then has again.
    provenance = defined(name, row.created_at)
    Repository(catalogue, archive).put({CAMPAIGN: definition}, provenance, forget, at=now)


def _decision(session: Session, path: str) -> AcceptanceRow | None:
    """Return the decision about a calibration that a file holds; None where a later one counts."""
    return session.scalar(
        select(AcceptanceRow).join(FileRow, FileRow.id == AcceptanceRow.file_id).where(FileRow.path == path)
    )


def _decide_again(catalogue: Catalogue, archive: Archive, path: str) -> None:
    with catalogue.reading() as session:
        row = _decision(session, path)
        assert row is not None
        rig, calibration = search.calibration_view(session, row.calibration_id).rig, row.calibration_id
        file = session.get_one(FileRow, session.get_one(CalibrationRow, calibration).file_id)
    acceptance = Acceptance(rig, file.content_hash, row.campaign or None, row.in_use)
    if archive.has(path):
        archive.set_aside(path)

    def forget(session: Session) -> None:
        session.execute(delete(AcceptanceRow).where(AcceptanceRow.file_id == row.file_id))
        retention.forget(session, [row.file_id])

    provenance = decided(acceptance, file.path, row.decided_at)
    Repository(catalogue, archive).put({ACCEPTANCE: acceptance}, provenance, forget)
