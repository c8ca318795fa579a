"""Calibrate: sensors, boards and poses of a ball bar in one adjustment, with the bar's length as scale."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from sms_jobs.errors import CalibrationFailed
from sms_jobs.kinds.calibration.calibrate_boards import LAST, PAGE, CalibrateParameters, adjusted, from_last
from sms_jobs.kinds.calibration.seen_boards import Boards
from sms_jobs.kinds.calibration.session_adjustment import Start, rigid_pose, start_from_last
from sms_jobs.kinds.calibration.session_doubts import alike_numbered
from sms_jobs.kinds.calibration.sessions import (
    CALIBRATE,
    OBSERVED_BARS,
    OBSERVED_BOARDS,
    START,
    START_OF_BOARDS,
    SessionPlan,
    bar_states,
    board_states,
    observations_of,
    observed,
    session_of,
    session_plan,
)
from sms_jobs.kinds.kind import (
    Inputs,
    Kind,
    Need,
    Output,
    Progress,
    Scope,
)
from sms_jobs.kinds.products import BAR, BOARD, CALIBRATED, QUALITY, UNCERTAINTY
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.sizes import number_of
from sms_jobs.records.subject import Subject


def _subjects(campaign: Campaign) -> Iterable[Subject]:
    return (Subject(campaign.name),) if bar_states(campaign) else ()


def _needs(campaign: Campaign, subject: Subject, parameters: CalibrateParameters) -> Iterable[Need]:
    boards = board_states(campaign)
    yield from observations_of(campaign, OBSERVED_BOARDS, boards)
    yield from observations_of(campaign, OBSERVED_BARS, bar_states(campaign))
    on_site = session_of(campaign).starts_from == "last-calibration"
    if boards:
        yield START_OF_BOARDS.of(subject)
    elif not on_site:
        yield START.of(subject)
    if on_site:
        yield LAST.of(subject)


def run(inputs: Inputs, parameters: CalibrateParameters, progress: Progress) -> Iterator[Output]:
    """Adjust boards and bar together, from what the boards alone gave."""
    plan: SessionPlan = inputs.context
    boards = observed(inputs, plan, OBSERVED_BOARDS, BOARD)
    bars, exchanged = alike_numbered(observed(inputs, plan, OBSERVED_BARS, BAR))
    if not any(len(one.sphere) for seen in bars.values() for one in seen):
        raise CalibrationFailed(
            f"no camera saw a sphere of the bar in any of its {len(bars)} poses; record them again, or "
            f"use the "
            "calibration from boards alone in a session without a bar"
        )
    start = _start(inputs, plan, boards)
    progress(0.2, f"adjusting {number_of(len(bars), 'pose')} of the bar and {len(boards)} of boards together")
    origin = f"bundle adjustment of session {plan.name}"
    yield from adjusted(inputs, plan, start, boards, bars, parameters, progress, origin, exchanged)


def _start(inputs: Inputs, plan: SessionPlan, boards: Boards) -> Start:
    """Return the first calibration as a start; its world stays that of the first board, if it had one.

    On site, lenses start from the last calibration, which says what is known of them.
    """
    first = inputs.read(START, CALIBRATED) if inputs.has(START) else None
    if inputs.has(LAST):
        last = from_last(inputs, plan, boards)
        if first is None:
            return last
        poses = {s.name: s.pose for s in first.rig.sensors}
        sensors = tuple(replace(s, pose=poses[s.name]) for s in last.rig.sensors)
        placed = start_from_last(plan, first, None, None, boards).boards
        return replace(last, rig=replace(last.rig, sensors=sensors), boards=placed)
    assert first is not None
    found = start_from_last(plan, first, None, None, boards)
    if not boards:
        return found
    world = next(p.label for p in plan.poses if p.label in boards)
    placed = {**found.boards, world: rigid_pose(plan.session.board_in_world)}
    return replace(found, boards=placed, world=world, origin=first.origin)


KIND = Kind(
    name=CALIBRATE,
    summary="calibrate a rig from poses of a ball bar and of a board",
    version=11,
    scope=Scope.CAMPAIGN,
    parameters=CalibrateParameters,
    inputs=(OBSERVED_BOARDS, OBSERVED_BARS, START, START_OF_BOARDS, LAST),
    outputs=(CALIBRATED, UNCERTAINTY, QUALITY, PAGE),
    needs=_needs,
    run=run,
    subjects=_subjects,
    context=session_plan,
)
