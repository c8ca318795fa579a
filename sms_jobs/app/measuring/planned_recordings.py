"""Plans of recordings: which state of a test is recorded next, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, TypeAlias

from sms_jobs.app.measuring.recordings import lacking, refuse_lacking
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.jobs.recording import planned_levels, planned_recordings, shown_plans
from sms_jobs.records.gauge_limits import NO_LOOK, GaugeLimit, Look
from sms_jobs.records.levels import Levels
from sms_jobs.records.people import Right
from sms_jobs.records.shown.planned_recordings import Dropped, PlannedRecording
from sms_jobs.records.triggers import Counted, Every, Holding, InTurn, Trigger
from sms_jobs.records.units import Typed, in_unit_of_name

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign, LoadState


@dataclass(frozen=True)
class InTime:
    """Record the states one after the other, so many seconds apart; without a time in turn, at once."""

    every_s: float | None = None


@dataclass(frozen=True)
class AtLoad:
    """Record each state when a channel has stayed near what the test plan says of it.

    Attributes
    ----------
    channel
        Of the rig.
    tolerance
        How near, in the unit of the channel or one of its family.
    for_s
        How long it must have stayed there.
    """

    channel: str
    tolerance: Typed
    for_s: float


@dataclass(frozen=True)
class AtCycles:
    """Record the states one after the other, each when a counter of the rig has come to its number.

    Attributes
    ----------
    counts
        One a state, each greater than the one before.
    channel
        That counts.
    for_s
        How long it must have stood still; 0 where the machine goes on.
    """

    counts: tuple[int, ...]
    channel: str
    for_s: float


@dataclass(frozen=True)
class AtLevels:
    """Give the campaign one more state at each multiple of a load, and record it there, until it is dropped.

    Attributes
    ----------
    channel
        Of the rig.
    each
        The load, in the unit of the channel or one of its family; 0 is a multiple of it.
    tolerance
        How near a multiple the channel must be, likewise.
    for_s
        How long it must have stayed there.
    """

    channel: str
    each: Typed
    tolerance: Typed
    for_s: float


OfStates: TypeAlias = InTime | AtLoad | AtCycles
"""What states wait for that are there."""
When: TypeAlias = OfStates | AtLevels


@use_case(Right.RECORD)
def plan(
    services: Services,
    campaign: str,
    when: When,
    states: Sequence[str] = (),
    *,
    ask: bool = False,
    process: bool = False,
    look: Look = NO_LOOK,
) -> list[PlannedRecording]:
    """Plan recordings, behind those that are planned, and return the whole plan of the campaign.

    Parameters
    ----------
    when
        What each of them waits for. A state that is planned already waits for this instead. Levels are behind
        all of them, whenever these are planned.
    states
        All that are neither recorded nor planned nor skipped if there is none; none for levels.
    ask, process
        See `recordings.record`.
    look
        Whether there is a quick look at each state once it is recorded, and which limits hold the plan.

    Raises
    ------
    NotFound
        There is no such campaign, state or gauge; or the rig of the channel is not connected to this host.
    Conflict
        A state is recorded, or being recorded; or nothing is left.
    InvalidInput
        The campaign is a calibration session, before whose poses somebody has to be there; the test plan does
        not say what the channel reads at a state; what is waited for does not fit channel or states; or there
        are cameras alone to look at, and nobody knows the size of a pixel; or no view can read a gauge that
        has a limit; or the rig lacks what the states are recorded with.
    """
    # Which loads the kinds; nothing else here needs them.
    from sms_jobs.jobs.recording import due_recordings

    now = datetime.now(UTC)
    by = services.actor.name
    with services.catalogue.reading() as session:
        defined = definition(campaign_row(session, campaign))
        due_recordings.refuse_session(defined)
        left = () if isinstance(when, AtLevels) else due_recordings.plannable(session, campaign, states)
    views = [view for state in left for view in defined.recordings_at(state.label)]
    refuse_lacking(lacking(services.stations, defined, views or defined.recordings))
    if look.enabled:
        _require_looked_at(services, defined, look.stop_if)
    if isinstance(when, AtLevels):
        levels = _levels(services, defined.rig, when, states)
        with services.catalogue.writing() as session:
            number = planned_recordings.lock(session, campaign)
            planned_levels.put(session, number, levels, by, now, ask=ask, process=process, look=look)
            return shown_plans.list_planned(session, now, campaign)
    wanted = _wanted(services, defined.rig, left, when, named=bool(states))
    with services.catalogue.writing() as session:
        planned_recordings.put(session, campaign, wanted, by, now, ask=ask, process=process, look=look)
        return shown_plans.list_planned(session, now, campaign)


def _require_looked_at(services: Services, campaign: Campaign, stop_if: Sequence[GaugeLimit]) -> None:
    """Refuse what a quick look cannot tell, which would stop the plan at the first load.

    Raises `InvalidInput` without a view to look at, or with a limit on a gauge that none can read, and
    `NotFound` for a gauge that is not described.
    """
    # Which loads the kinds, as the states have so far.
    from sms_jobs.formats.gauge_descriptions import described_gauge
    from sms_jobs.jobs.planning.gauge_places import check_looked_at
    from sms_jobs.kinds.deformation.quick_look import declared_gauges, subjects_looked_at

    views = {one.view or "": None for one in subjects_looked_at(campaign)}
    if not views:
        raise InvalidInput(
            f"{campaign.name} has cameras alone, and nobody said how large a pixel is on the specimen: give "
            "mm_per_px under [processing.plane] of the test plan, or leave out `look` and `stop_if`"
        )
    known = list(
        dict.fromkeys(
            described_gauge(text).name for view in views for text in declared_gauges(campaign, view)
        )
    )
    in_mm = " in mm" if campaign.shape_views else ""
    for limit in stop_if:
        if limit.gauge not in known:
            raise NotFound(
                f"{campaign.name} has no gauge '{limit.gauge}'{in_mm}; it has {', '.join(known) or 'none'}: "
                "describe it under [processing.gauges] of the test plan"
            )
    if stop_if:
        with services.catalogue.reading() as session:
            limited = [limit.gauge for limit in stop_if]
            check_looked_at(session, services.archive, campaign, list(views), limited)


def _levels(services: Services, rig: str, when: AtLevels, states: Sequence[str]) -> Levels:
    """Return levels in the unit of their channel; raise `InvalidInput` where they cannot be told apart."""
    if states:
        raise InvalidInput(
            f"`each` adds states to the campaign, and {', '.join(states)} is no new one: leave out `state` "
            "or `each`"
        )
    unit = services.stations.unit(rig, when.channel)
    step, tolerance = when.each.in_unit(unit, "`each`"), _tolerance(when.tolerance, unit)
    if step <= 0.0:
        raise InvalidInput(f"`each` is '{when.each.text}', and loads are apart by more than 0: give more")
    if step <= 2.0 * tolerance:
        raise InvalidInput(
            f"`each` is '{when.each.text}' and `tolerance` '{when.tolerance.text}': a reading between two "
            f"multiples would be near both; give a tolerance below {step / 2.0:g} {unit}, or a greater load"
        )
    return Levels(when.channel, unit, step, tolerance, when.for_s)


def _wanted(
    services: Services,
    rig: str,
    states: Sequence[LoadState],
    when: OfStates,
    *,
    named: bool,
) -> list[tuple[str, Trigger]]:
    """Return by state what its recording waits for; of those that nobody has `named` only the first may."""
    if isinstance(when, InTime):
        trigger = InTurn() if when.every_s is None else Every(when.every_s)
        return [(state.label, trigger) for state in states]
    unit = services.stations.unit(rig, when.channel)
    if isinstance(when, AtLoad):
        return [(state.label, _holding(state, when, unit)) for state in states]
    if len(when.counts) > len(states) or (named and len(when.counts) < len(states)):
        raise InvalidInput(
            f"{len(when.counts)} numbers of cycles are given for {len(states)} states; give one for each, or "
            "add states with 'sms campaign add-state'"
        )
    return [
        (state.label, Counted(when.channel, count, when.for_s))
        for state, count in zip(states, when.counts, strict=False)
    ]


def _holding(state: LoadState, when: AtLoad, unit: str) -> Holding:
    # Which loads the instruments, as the states have so far.
    from sms_jobs.jobs.recording.recordings import state_value

    # The test plan says it in the unit of the channel's name.
    target = state_value(state, when.channel) / in_unit_of_name(when.channel, 1.0, unit)
    return Holding(when.channel, unit, target, _tolerance(when.tolerance, unit), when.for_s)


def _tolerance(given: Typed, unit: str) -> float:
    tolerance = given.in_unit(unit, "`tolerance`")
    if tolerance <= 0.0:
        raise InvalidInput(
            f"`tolerance` is '{given.text}', and no reading is ever that near: give one above 0"
        )
    return tolerance


@use_case(Right.READ)
def show(services: Services, campaign: str | None = None) -> list[PlannedRecording]:
    """Return the plan of a campaign, or all with something left; raise `NotFound` where there is none."""
    with services.catalogue.reading() as session:
        return shown_plans.list_planned(session, datetime.now(UTC), campaign)


@use_case(Right.RECORD)
def hold(services: Services, campaign: str, states: Sequence[str] = ()) -> list[str]:
    """Hold planned recordings back, or the whole plan, and return the states of which that is new.

    Raises
    ------
    NotFound
        There is no such campaign, or nothing is planned of such a state.
    Conflict
        One has already started.
    """
    with services.catalogue.writing() as session:
        return planned_recordings.set_held(session, campaign, states, True)


@use_case(Right.RECORD)
def go(services: Services, campaign: str, states: Sequence[str] = ()) -> list[str]:
    """Let recordings that were held back go on, and return their states; raises as `hold` does."""
    with services.catalogue.writing() as session:
        return planned_recordings.set_held(session, campaign, states, False)


@use_case(Right.RECORD)
def skip(services: Services, campaign: str, states: Sequence[str] = ()) -> list[str]:
    """Leave planned recordings out, or the next one, and return their states.

    Raises
    ------
    NotFound
        There is no such campaign, or nothing is planned of such a state.
    Conflict
        One is recorded, or being recorded.
    """
    with services.catalogue.writing() as session:
        return planned_recordings.skip(session, campaign, states)


@use_case(Right.RECORD)
def move(services: Services, campaign: str, state: str, before: str | None = None) -> None:
    """Let a planned recording come before another one, or last.

    Raises
    ------
    NotFound
        There is no such campaign, or nothing is planned of such a state.
    Conflict
        One of them has already started, or is skipped.
    """
    with services.catalogue.writing() as session:
        planned_recordings.move(session, campaign, state, before)


@use_case(Right.RECORD)
def drop(services: Services, campaign: str, states: Sequence[str] = ()) -> Dropped:
    """Forget recordings of a plan, or all that do not run, and return which, and what stays.

    What was recorded stays, and so do states that were added; raises as `skip` does, but not for one that is
    recorded.
    """
    with services.catalogue.writing() as session:
        return planned_recordings.drop(session, campaign, states)
