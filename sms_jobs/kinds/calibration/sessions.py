"""What the job kinds of a calibration session have in common: its poses, and who observes them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from itertools import combinations

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import CALIBRATION, Inputs, Need, Port
from sms_jobs.kinds.products import BAR, BOARD, CALIBRATED, QUALITY, Product, R
from sms_jobs.records.artefacts import Artefact, BallBar
from sms_jobs.records.campaign import CalibrationSession, Campaign, LoadState
from sms_jobs.records.sensors import SensorFormat
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

OBSERVE_BOARD = "observe-board"
CALIBRATE_BOARDS = "calibrate-boards"
OBSERVE_BAR = "observe-bar"
CALIBRATE = "calibrate"
OBSERVED_BOARDS = Port("board", OBSERVE_BOARD, (BOARD,), several=True)
OBSERVED_BARS = Port("bar", OBSERVE_BAR, (BAR,), several=True)
START = Port("start", CALIBRATION, (CALIBRATED, QUALITY))
"""A calibration to begin with."""
START_OF_BOARDS = START.made_by(CALIBRATE_BOARDS)
"""Name of the record that `observe-board` and `observe-bar` make."""


@dataclass(frozen=True)
class SessionPose:
    """One pose of an artefact.

    Attributes
    ----------
    label
        Of the state.
    artefact
        Name in the session.
    angles_rad
        Pan and tilt of the stage, where it is known.
    """

    label: str
    artefact: str
    angles_rad: tuple[float, float] | None


@dataclass(frozen=True)
class SessionPlan:
    """What a calibration depends on of its campaign.

    Attributes
    ----------
    name, rig
        Of the campaign and the rig.
    began
        Time of the first pose, if known.
    poses, views
        In order.
    """

    name: str
    rig: str
    began: datetime | None
    session: CalibrationSession
    poses: tuple[SessionPose, ...]
    views: tuple[str, ...]

    def measuring_pairs(self) -> tuple[tuple[str, str], ...]:
        """Return the pairs of sensors that measure points: cameras with projectors, or cameras alone."""
        sensors_by_view = [view_of(view).sensors for view in self.views]
        alone = [sensors[0] for sensors in sensors_by_view if len(sensors) == 1]
        return (*((s[0], s[1]) for s in sensors_by_view if len(s) == 2), *combinations(alone, 2))


def session_of(campaign: Campaign) -> CalibrationSession:
    """Return the session that a campaign is; raise `InvalidInput` for a test."""
    if campaign.session is None:
        raise InvalidInput(
            f"campaign {campaign.name} is no calibration session; describe its artefacts under [session]"
        )
    return campaign.session


def session_plan(campaign: Campaign, subject: Subject) -> SessionPlan:
    """Return what a calibration depends on; raise `InvalidInput` for a campaign that is no session."""
    session = session_of(campaign)
    poses = tuple(
        SessionPose(state.label, state.artefact, angles(state))
        for state in campaign.states
        if state.artefact is not None
    )
    return SessionPlan(campaign.name, campaign.rig, campaign.states[0].time, session, poses, campaign.views)


def angles(state: LoadState) -> tuple[float, float] | None:
    """Return the pan and tilt of a state in rad; None where they were not recorded."""
    if "pan_rad" in state.channels and "tilt_rad" in state.channels:
        return state.channels["pan_rad"], state.channels["tilt_rad"]
    return None


def artefact_of(campaign: Campaign, state: LoadState) -> Artefact | None:
    """Return the artefact that a state shows."""
    if campaign.session is None or state.artefact is None:
        return None
    return campaign.session.artefacts[state.artefact]


def board_states(campaign: Campaign) -> tuple[LoadState, ...]:
    """Return the states that show a board."""
    return tuple(
        s
        for s in campaign.states
        if s.artefact is not None and not isinstance(artefact_of(campaign, s), BallBar)
    )


def bar_states(campaign: Campaign) -> tuple[LoadState, ...]:
    """Return the states that show a ball bar."""
    return tuple(s for s in campaign.states if isinstance(artefact_of(campaign, s), BallBar))


def every_view(campaign: Campaign, states: Iterable[LoadState]) -> tuple[Subject, ...]:
    """Return the tuples of some states."""
    return tuple(Subject(campaign.name, s.label, p) for s in states for p in campaign.views)


def observations_of(campaign: Campaign, port: Port, states: Iterable[LoadState]) -> Iterable[Need]:
    """Return the need for what every view observed in some states."""
    return map(port.of, every_view(campaign, states))


def observed(inputs: Inputs, plan: SessionPlan, port: Port, product: Product[R]) -> dict[str, list[R]]:
    """Return what every view observed, by pose."""
    found: dict[str, list[R]] = {}
    for pose in plan.poses:
        for view in plan.views:
            own = Subject(plan.name, pose.label, view)
            if inputs.has(port, about=own):
                found.setdefault(pose.label, []).append(inputs.read(port, product, own))
    return found


def sensor_format(session: CalibrationSession, name: str) -> SensorFormat:
    """Return the size of a sensor's image; raise `InvalidInput` where the session does not tell it."""
    for sensor in session.sensors:
        if sensor.name == name:
            return sensor
    known = ", ".join(s.name for s in session.sensors)
    raise InvalidInput(
        f"the session does not say how many pixels {name} has; it knows {known or 'no sensor'}: "
        "add it under [[session.sensors]]"
    )
