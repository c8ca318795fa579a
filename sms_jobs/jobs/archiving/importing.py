"""Enters what was measured elsewhere: the same content once.

Each tuple is one sealed file and one transaction. Its provenance has a hash of the sources of
the file, so that a second import finds what is there and changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow, MeasurementRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.formats.importers.readings import Reading
from sms_jobs.jobs.archiving.indexing import CAMPAIGN
from sms_jobs.jobs.archiving.registration import defined
from sms_jobs.jobs.archiving.repository import Repository, brought_in
from sms_jobs.kinds import kind_named
from sms_jobs.kinds.calibration.sessions import OBSERVE_BOARD
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.products import BOARD
from sms_jobs.records.campaign import Campaign, CampaignDefinition, LoadState
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

if TYPE_CHECKING:
    from sms_jobs.records.measurement import Measurement
    from sms_jobs.records.observations import BoardObservation

SOURCE_HASH = "source_sha256"
"""The parameter of an imported file that tells what it was made from."""

_TRIES = 20
"""So often states are added anew because a campaign was changed meanwhile."""

Status: TypeAlias = Literal["new", "there", "other"]


@dataclass(frozen=True)
class ExistingMeasurement:
    """What the archive has of a tuple that is to be imported.

    Attributes
    ----------
    status
        new: nothing. there: the same content. other: another measurement.
    path
        Of the newest measurement.
    """

    status: Status
    path: str = ""


def existing_measurement(
    catalogue: Catalogue, archive: Archive, subject: Subject, source_sha256: str
) -> ExistingMeasurement:
    """Say whether a tuple has a measurement already, and whether it is of the same sources."""
    with catalogue.reading() as session:
        paths = _measurements(session, subject)
    for path in paths:
        provenance = archive.provenance(path)
        if provenance is not None and provenance.parameters.get(SOURCE_HASH) == source_sha256:
            return ExistingMeasurement("there", path)
    return ExistingMeasurement("other", paths[0]) if paths else ExistingMeasurement("new")


def _measurements(session: Session, subject: Subject) -> list[str]:
    """Return the paths of a tuple's measurements, the newest first; none where nothing is known of it."""
    query = (
        select(FileRow.path)
        .join(CampaignRow, CampaignRow.id == FileRow.campaign_id)
        .join(LoadStateRow, LoadStateRow.id == FileRow.state_id)
        .where(
            FileRow.source == MEASUREMENT,
            CampaignRow.name == subject.campaign,
            LoadStateRow.label == subject.state,
            FileRow.view == subject.view,
        )
        .order_by(FileRow.id.desc())
    )
    return list(session.scalars(query))


def measured_tuples(session: Session, campaign: Campaign) -> set[tuple[str, str]]:
    """Return the states and views of a campaign of which the archive has a measurement."""
    query = (
        select(LoadStateRow.label, MeasurementRow.view)
        .join(MeasurementRow, MeasurementRow.state_id == LoadStateRow.id)
        .join(CampaignRow, CampaignRow.id == LoadStateRow.campaign_id)
        .where(CampaignRow.name == campaign.name)
    )
    return {(label, view) for label, view in session.execute(query)}


@dataclass(frozen=True)
class ImportedFile:
    """A file that a measurement in the archive was made of: its tuple, its name and its SHA-256."""

    subject: Subject
    name: str
    sha256: str


def imported_files(catalogue: Catalogue, archive: Archive, campaign: str) -> Iterator[ImportedFile]:
    """Yield the files that the measurements of a campaign were made of, the newest of each tuple alone.

    What a job recorded was made of none, and is not opened.
    """
    query = (
        select(LoadStateRow.label, FileRow.view, FileRow.path, FileRow.job_id)
        .join(CampaignRow, CampaignRow.id == FileRow.campaign_id)
        .join(LoadStateRow, LoadStateRow.id == FileRow.state_id)
        .where(FileRow.source == MEASUREMENT, CampaignRow.name == campaign, FileRow.view.is_not(None))
        .order_by(FileRow.id)
    )
    with catalogue.reading() as session:
        newest = {Subject(campaign, row.label, row.view): row for row in session.execute(query)}
    for subject, row in newest.items():
        provenance = None if row.job_id else archive.provenance(row.path)
        files = [] if provenance is None else provenance.parameters.get("files", [])
        yield from (ImportedFile(subject, one["name"], one["sha256"]) for one in files)


def import_measurement(
    catalogue: Catalogue,
    archive: Archive,
    subject: Subject,
    measurement: Measurement,
    source_sha256: str,
    parameters: Mapping[str, Any],
    now: datetime,
    *,
    newer: bool = False,
) -> ExistingMeasurement:
    """Seal and index the measurement of a tuple, unless it is there.

    Parameters
    ----------
    source_sha256
        Of the files that it is made from and of how they are read.
    parameters
        What else its provenance tells: the folder, the files, the layout.
    newer
        Whether it may be entered beside another measurement of the tuple; the newest is used from then on.

    Returns
    -------
    What was known of the tuple before, with the path of the file that holds it now.

    Raises
    ------
    Conflict
        The tuple has another measurement; nothing is changed.
    """
    known = existing_measurement(catalogue, archive, subject, source_sha256)
    if known.status == "there":
        return known
    if known.status == "other" and not newer:
        raise Conflict(
            f"{subject} already has another measurement, {known.path}: set `newer` to enter this one beside "
            "it and use it from now on"
        )
    with catalogue.reading() as session:
        before = _measurements(session, subject)
    kept = Repository(catalogue, archive).put(
        {MEASUREMENT: measurement},
        brought_in(MEASUREMENT, subject, now, parameters={SOURCE_HASH: source_sha256, **parameters}),
        lambda session: _require_same(_measurements(session, subject), before, str(subject)),
    )
    return ExistingMeasurement(known.status, kept.path)


def _require_same(now: object, before: object, what: str) -> None:
    if now != before:
        raise Conflict(f"{what} was changed by someone else meanwhile: import again")


def import_observations(
    catalogue: Catalogue,
    archive: Archive,
    campaign: Campaign,
    observations: Mapping[str, Mapping[str, BoardObservation]],
    parameters: Mapping[str, Any],
    now: datetime,
) -> None:
    """Seal and index what another program saw of the board of a session, by pose and view: all, or nothing.

    It stands where `observe-board` would have put it, without a job.
    """
    kind = kind_named(OBSERVE_BOARD)
    with Repository(catalogue, archive).batch() as batch:
        for label, of_pose in observations.items():
            for view, observation in of_pose.items():
                subject = Subject(campaign.name, label, view)
                provenance = brought_in(kind.name, subject, now, version=kind.version, parameters=parameters)
                batch.seal({BOARD.name: observation}, provenance)
        batch.enter()


def with_states(campaign: Campaign, labels: Iterable[str]) -> Campaign:
    """Return a campaign with states of further labels behind its own."""
    existing = {s.label for s in campaign.states}
    added = tuple(LoadState(label) for label in labels if label not in existing)
    return replace(campaign, states=campaign.states + added)


def add_states(
    catalogue: Catalogue, archive: Archive, campaign: str, labels: Sequence[str], now: datetime
) -> None:
    """Give a campaign those of some states that it does not have, whatever else is added meanwhile.

    Raises `Conflict` where it changes faster than that.
    """
    for attempt in range(_TRIES):
        with catalogue.reading() as session:
            before = campaigns.definition(campaigns.campaign_row(session, campaign))
        after = with_states(before, labels)
        if after == before:
            return
        try:
            amend_campaign(catalogue, archive, before, after, now)
        except Conflict:
            if attempt == _TRIES - 1:
                raise


def with_state(campaign: Campaign, state: LoadState) -> Campaign:
    """Return a campaign of a specimen with one more state behind its own.

    Raises
    ------
    Conflict
        It has a state of that label, or of one that differs only in case.
    InvalidInput
        It is a calibration session.
    """
    if campaign.session is not None:
        raise InvalidInput(f"{campaign.name} is a calibration session, whose poses are those of its plan")
    for there in (one.label for one in campaign.states):
        if there.lower() == state.label.lower():
            but = "" if there == state.label else f", from which {state.label} differs only in case"
            raise Conflict(f"campaign {campaign.name} has a state {there} already{but}; choose another label")
    return replace(campaign, states=(*campaign.states, state))


def with_view(campaign: Campaign, view: str, recorded: Mapping[str, Set[str]]) -> Campaign:
    """Return a campaign that is measured by one more view from now on, or by one of its own more often.

    Parameters
    ----------
    recorded
        What there are frames of, at each state that was recorded.

    Raises
    ------
    Conflict
        It has that view already, and no frames of a state that it had none of.
    InvalidInput
        It is a calibration session, or this is no view.
    """
    if campaign.session is not None:
        raise InvalidInput(f"{campaign.name} is a calibration session, whose views are those of its plan")
    needed = {str(one) for one in view_of(view).recordings}
    states = []
    for state in campaign.states:
        lacks = state.label in recorded and not needed <= recorded[state.label]
        unseen = (*(one for one in state.unseen_by if one != view), *([view] if lacks else []))
        states.append(replace(state, unseen_by=unseen))
    views = campaign.views if view in campaign.views else (*campaign.views, view)
    after = replace(campaign, states=tuple(states), views=views)
    if after == campaign or (view in campaign.views and view not in campaign.late_views):
        raise Conflict(
            f"campaign {campaign.name} is measured by {', '.join(campaign.views)}, and nothing more of "
            f"{view} is there; choose another view, or bring its frames in first"
        )
    return after


def measured_at(session: Session, campaign: Campaign) -> dict[str, datetime]:
    """Return when the states of a campaign were held: as they say, or when they were first recorded."""
    query = (
        select(LoadStateRow.label, func.min(MeasurementRow.recorded_at))
        .join(MeasurementRow, MeasurementRow.state_id == LoadStateRow.id)
        .join(CampaignRow, CampaignRow.id == LoadStateRow.campaign_id)
        .where(CampaignRow.name == campaign.name)
        .group_by(LoadStateRow.label)
    )
    recorded = dict(session.execute(query).all())
    times = {s.label: s.time or recorded.get(s.label) for s in campaign.states}
    return {label: time for label, time in times.items() if time is not None}


def with_readings(
    campaign: Campaign, readings: Sequence[Reading], *, replace_others: bool = False
) -> tuple[Campaign, list[str]]:
    """Return a campaign whose states have further readings, and what has changed, in words.

    Raises
    ------
    InvalidInput
        A state is unknown.
    Conflict
        A state has another value already, and nobody has said that it is to be replaced.
    """
    changes: list[str] = []
    states = {s.label: s for s in campaign.states}
    for reading in readings:
        campaign.state(reading.state)
        states[reading.state] = _read(states[reading.state], reading, changes, replace_others)
    return replace(campaign, states=tuple(states.values())), changes


def _read(state: LoadState, reading: Reading, changes: list[str], replace_others: bool) -> LoadState:
    given: dict[str, Any] = {
        "measured_load_n": reading.load_n,
        "measured_displacement_mm": reading.displacement_mm,
        "time": reading.time,
    }
    given = {name: value for name, value in given.items() if value is not None}
    had: dict[str, Any] = {name: getattr(state, name) for name in given} | dict(state.channels)
    for name, value in (given | dict(reading.channels)).items():
        old = had.get(name)
        if old == value:
            continue
        if old is not None and not replace_others:
            raise Conflict(
                f"state {state.label} has {name} = {old} already, and {value} is to be entered: set "
                "`replace` to use the new one"
            )
        changes.append(f"{state.label}: {name} = {value}" + ("" if old is None else f" (was {old})"))
    return replace(state, channels={**state.channels, **reading.channels}, **given)


def amend_campaign(
    catalogue: Catalogue,
    archive: Archive,
    before: Campaign,
    after: Campaign,
    now: datetime,
    allow: Callable[[Session], None] = lambda session: None,
    then: Callable[[Session], None] = lambda session: None,
) -> None:
    """Give a campaign further states, views or readings, or another frame: sealed, then in the catalogue.

    Parameters
    ----------
    allow, then
        Called in the transaction that changes it, before and after; `allow` raises where it must not be
        changed just now, and whatever either raises leaves it as it was.

    Raises
    ------
    InvalidInput
        Something else would change: name, rig, fringes, or the order of the states or views.
    Conflict
        The campaign is not `before` any more; nothing is changed.
    """
    if not continues(before, after):
        raise InvalidInput(
            f"campaign {before.name} can be given states, views, readings and a frame, nothing else changes"
        )
    with catalogue.reading() as session:
        row = campaigns.campaign_row(session, before.name)
        # A clock that was set back must not make the earlier definition the later one.
        defined_at = session.scalar(
            select(func.max(FileRow.created_at)).where(
                FileRow.campaign_id == row.id, FileRow.source == CAMPAIGN
            )
        )
        now = now if defined_at is None else max(now, defined_at + timedelta(microseconds=1))

    def check(session: Session) -> None:
        # Of two who change it at once the second waits here, and finds that it is not `before` any more.
        session.execute(
            select(CampaignRow.id).where(CampaignRow.id == row.id).with_for_update(key_share=True)
        )
        present = campaigns.definition(campaigns.campaign_row(session, before.name))
        _require_same(present, before, f"campaign {before.name}")
        allow(session)

    definition = CampaignDefinition(after, row.plan)
    Repository(catalogue, archive).put({CAMPAIGN: definition}, defined(before.name, now), check, then)


def continues(before: Campaign, after: Campaign) -> bool:
    """Say whether a campaign is another with further states or views, other readings, or another frame."""
    same = replace(after, states=before.states, views=before.views, frame=before.frame) == before
    labels = [state.label for state in after.states[: len(before.states)]]
    further = after.views[: len(before.views)] == before.views
    return same and further and labels == [state.label for state in before.states]
