"""Acquire: one measurement of every view at a state, with the instruments of the rig.

It happens once: what was recorded cannot be asked for again when the load has gone. Interrupted, the job
waits for an operator; resumed, it records what is missing and nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from pydantic import Field, field_validator

from sms_jobs.errors import InstrumentError, InvalidInput
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.connection import connected
from sms_jobs.instruments.devices.device import POLLS_EVERY_S
from sms_jobs.instruments.judging import APART_S, Limits
from sms_jobs.instruments.kept_sets import finished_sets, interrupted, recorded
from sms_jobs.instruments.recorder import record_state
from sms_jobs.instruments.recording_sets import Adaptation, Patterns
from sms_jobs.instruments.simulated.optics import Setting
from sms_jobs.kinds.kind import (
    MEASUREMENT,
    DatasetOutput,
    Inputs,
    Kind,
    Output,
    P,
    Progress,
    Queue,
    Scope,
    Station,
    never,
    no_needs,
    rig_queue,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import INTERRUPTED, MEASURED, RECORDED
from sms_jobs.kinds.recording.adaptation import (
    QUICK,
    Adaptive,
    adaptation_statistics,
    adapted,
)
from sms_jobs.kinds.recording.simulate import deformation_at, scene_at
from sms_jobs.metrology.geometry.stage_poses import StagePose
from sms_jobs.records.artefacts import BallBar
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.optical_instruments import ImageFormat
from sms_jobs.records.recording import Recording
from sms_jobs.records.remarks import remarked
from sms_jobs.records.sizes import number_of
from sms_jobs.records.statistic_names import (
    DOUBTS,
    LIT_FRACTION,
    MODULATION,
    RECORDINGS,
    RETAKEN_FRAMES,
    SATURATED_FRACTION,
    after,
    before,
)
from sms_jobs.records.subject import Subject

ANGLES = ("pan_rad", "tilt_rad")
"""The channels of a state that say where a stage is to be."""
_SPHERES_FILL = 1e-4
"""Two spheres of 16 px across, the least that a centre can be found from, in an image of four megapixels."""
_CHANNEL = re.compile(
    r"(?P<name>[A-Za-z0-9][A-Za-z0-9._-]*)(?:=(?P<limit>[0-9]+(?:\.[0-9]*)?(?:e[-+]?[0-9]+)?))?"
)


class AcquireParameters(Parameters):
    """What is recorded follows from the campaign; when a set is good enough is said here."""

    saturated_fraction: float = Field(
        0.02, ge=0.0, le=1.0, description="most of the lit region that may be saturated"
    )
    lit_fraction: float = Field(
        0.01,
        ge=0.0,
        le=1.0,
        description="least part of the image in which fringes must stand out, or texture where nothing is "
        "projected; of a ball bar 0.0001 at most",
    )
    recordings: int = Field(
        2, ge=1, le=10, description="how often a set is recorded until it keeps these limits"
    )
    texture_exposure: float = Field(
        1.0,
        gt=0.0,
        description="exposure of the white frame, and of images without a projector, in units of the "
        "camera's own",
    )
    adaptive: Adaptive = Field(
        "none",
        description="what a quick pre-exposure of each projector's views decides: nothing, the set of "
        "exposures that keeps every pixel of its cameras in range instead of that of the sequence, or where "
        "the projector is dimmed so that one exposure does",
    )
    longest_exposure: float = Field(
        1.0,
        gt=0.0,
        description="exposure that an adaptive set does not exceed, in units of the camera's own",
    )
    apart_ms: float = Field(
        1e3 * APART_S,
        ge=0.0,
        description="how far apart the images of cameras without a projector may be, which have to show one "
        "state: at a cross-head's 2 mm a minute 10 ms are a third of a micrometre",
    )
    channels: tuple[str, ...] = Field(
        (),
        description="channels of the rig that have to be read before and after every set, such as load_n; as "
        "load_n=3000 a set is doubted during which it went by more, in the unit of its name",
    )
    doubtful: Literal["keep", "ask"] = Field(
        "keep",
        description="what becomes of a set that does not keep them even so: it is kept and says so, or an "
        "operator is asked while the specimen is still held",
    )

    @field_validator("channels", mode="before")
    @classmethod
    def _one_or_several(cls, given: Any) -> Any:
        return tuple(given.split()) if isinstance(given, str) else given

    @field_validator("channels")
    @classmethod
    def _each_once(cls, channels: tuple[str, ...]) -> tuple[str, ...]:
        """Refuse what is no channel, or one that is named twice."""
        if len(_drift_limits(channels)) < len(channels):
            raise ValueError(f"names a channel twice: {', '.join(channels)}")
        return channels

    def adaptation(
        self, sequence: FringeSequence, projectors: Sequence[ImageFormat], threads: int
    ) -> Adaptation | None:
        """Return how patterns follow from a pre-exposure; None where they are as planned."""
        if self.adaptive == "none":
            return None
        named = {one.name: one for one in projectors}

        def patterns(projector: str, quick: Sequence[Measurement]) -> Patterns:
            shown = named[projector]
            return adapted(self.adaptive, self.longest_exposure, sequence, shown, quick, threads)

        return Adaptation(QUICK, patterns)

    def limits(self) -> Limits:
        """Return what a set must keep."""
        return Limits(
            self.saturated_fraction,
            self.lit_fraction,
            self.recordings,
            _drift_limits(self.channels),
            1e-3 * self.apart_ms,
        )


def _drift_limits(channels: tuple[str, ...]) -> dict[str, float | None]:
    """Return by channel how far it may go while a set is recorded; None where nothing is said."""
    found: dict[str, float | None] = {}
    for text in channels:
        written = _CHANNEL.fullmatch(text)
        if written is None:
            raise ValueError(f"'{text}' is no channel: write load_n, or load_n=3000 with how far it may go")
        limit = written["limit"]
        found[written["name"]] = None if limit is None else float(limit)
    return found


@dataclass(frozen=True)
class Order:
    """What is to be recorded.

    Attributes
    ----------
    views, sequence
        All of them: a camera and its projector, or a camera whose texture is recorded without one.
    angles_rad
        Where a stage has to bring an artefact: pan and tilt; None where nothing moves.
    setting
        What stands before simulated instruments; None where nothing is simulated.
    fills
        What part of the image may at least be asked to be lit: the spheres of a bar fill little of it.
    speckled
        Whether a specimen stands there, and no artefact.
    """

    views: tuple[str, ...]
    sequence: FringeSequence
    angles_rad: tuple[float, float] | None
    setting: Setting | None
    fills: float = 1.0
    speckled: bool = True


def stage_angles(state: LoadState) -> tuple[float, float] | None:
    """Return where a stage has to be brought at a state, pan and tilt in rad; None where nothing moves."""
    pan, tilt = (state.channels.get(name) for name in ANGLES)
    return None if pan is None or tilt is None else (pan, tilt)


def order(campaign: Campaign, subject: Subject) -> Order:
    """Return what is to be recorded at a state."""
    state = campaign.state(subject.state or "")
    shown = None if campaign.session is None else campaign.session.artefacts.get(state.artefact or "")
    fills = _SPHERES_FILL if isinstance(shown, BallBar) else 1.0
    return Order(
        campaign.recordings_at(state.label),
        campaign.sequence,
        stage_angles(state),
        setting_at(campaign, state),
        fills,
        state.artefact is None,
    )


def setting_at(campaign: Campaign, state: LoadState) -> Setting | None:
    """Return what stands before simulated instruments at a state; None where no scene is described."""
    if campaign.scene is None:
        return None
    scene = scene_at(campaign.scene, campaign, state)
    return Setting(scene, state.label, deformation_at(campaign, state), state.planned())


def all_states(campaign: Campaign) -> tuple[Subject, ...]:
    """Return every state, of specimens and artefacts alike."""
    return tuple(Subject(campaign.name, s.label) for s in campaign.states)


def run(inputs: Inputs, parameters: AcquireParameters, progress: Progress) -> Iterator[Output]:
    """Record every view of a state that is not in the spool yet, and yield them all.

    Raises
    ------
    InvalidInput
        When the rig's file lacks what is to be recorded with.
    MeasurementFailed
        When nothing is lit in a pre-exposure.
    InstrumentError
        When an instrument gives up, or a set is doubtful and an operator is to be asked.
    """
    task: Order = inputs.context
    station = station_of(inputs, task.setting)
    spool, sequence = station.spool, task.sequence
    limits = parameters.limits()
    limits = replace(limits, lit_fraction=min(limits.lit_fraction, task.fills), speckled=task.speckled)
    finished_before = finished_sets(spool)
    with connected(station.rig, task.setting, inputs.threads) as rig:
        if task.angles_rad is not None:
            _bring_stage(rig, task.angles_rad, inputs.subject, progress)
        record_state(
            rig,
            task.views,
            sequence,
            spool,
            limits,
            lambda f, words: progress(0.8 * f, words),
            parameters.texture_exposure,
            parameters.adaptation(sequence, station.rig.projectors, inputs.threads),
        )
    # What an operator saw and let stand is not doubted again.
    new = [view for view in task.views if view not in finished_before]
    doubts = [d for view in new for d in recorded(spool, view, sequence)[1].verdict.doubts]
    if doubts and parameters.doubtful == "ask":
        raise InstrumentError(
            f"{'; '.join(doubts)}: `sms acquire resume` keeps it, and with --retake records it again"
        )
    for number, view in enumerate(task.views):
        progress(0.8 + 0.2 * number / len(task.views), f"archiving {view}")
        measurement, recording = recorded(spool, view, sequence)
        broken = {
            INTERRUPTED.of(str(n)): r for n, r in enumerate(interrupted(spool, view, sequence), start=1)
        }
        yield DatasetOutput(
            Subject(inputs.subject.campaign, inputs.subject.state, view),
            {MEASURED: measurement, RECORDED: recording, **broken},
            statistics_of(recording)
            | (adaptation_statistics(measurement) if parameters.adaptive != "none" else {}),
        )
    progress(1.0, remarked(*doubts, beside=f"recorded {number_of(len(task.views), 'view')}"))


def station_of(inputs: Inputs, setting: Setting | None) -> Station:
    """Return where a job records.

    Raises `InvalidInput` without a rig, without a scene for a simulated one, or with one whose images have
    another size.
    """
    station = inputs.station
    if station is None:
        raise InvalidInput(
            f"{inputs.subject} is recorded where its rig is connected, and no rig file is on this host; "
            "`sms rig add` takes one"
        )
    if station.rig.simulated and setting is None:
        raise InvalidInput(
            f"rig {station.rig.name} is simulated, and campaign {inputs.subject.campaign} describes no scene "
            "for it to look at: give its plan a [scene], or name a rig with real sensors"
        )
    if station.rig.simulated and setting is not None:
        planned = setting.scene.rig.sensors
        there = [one.name for one in planned if one.name in station.rig.sensors]
        if differing := station.rig.lacking(there, planned):
            raise InvalidInput("; ".join(differing))
    return station


def _bring_stage(
    rig: ConnectedRig, angles_rad: tuple[float, float], subject: Subject, progress: Progress
) -> None:
    """Bring the artefact into its pose; a job that is to stop stops on the way."""
    if rig.stage is None:
        raise InvalidInput(
            f"{subject} has pan and tilt angles, but the file of rig {rig.name} describes no stage under "
            "[[stages]]"
        )
    progress(0.0, "making the stage ready")
    rig.stage.stage()
    moving = rig.stage.set(StagePose(*angles_rad))
    while not moving.update():
        progress(0.0, f"moving the stage: {moving.progress:.0%}")
        rig.clock.sleep(POLLS_EVERY_S)
    moving.wait()  # raises what the move ended with


def statistics_of(recording: Recording) -> dict[str, float]:
    """Return what people search recordings by."""
    verdict = recording.verdict
    of_an_image = {
        "contrast_to_noise": verdict.contrast_to_noise,
        "level": verdict.level,
        "apart_ms": None if recording.apart_s is None else 1e3 * recording.apart_s,
    }
    return {
        SATURATED_FRACTION: verdict.saturated_fraction,
        LIT_FRACTION: verdict.lit_fraction,
        MODULATION: verdict.modulation,
        DOUBTS: float(len(verdict.doubts)),
        RETAKEN_FRAMES: float(recording.retaken),
        RECORDINGS: float(recording.recordings),
        **{name: value for name, value in of_an_image.items() if value is not None},
        **{before(name): value for name, value in recording.channels_before.items()},
        **{after(name): value for name, value in recording.channels_after.items()},
    }


def whole_rig(campaign: Campaign, subject: Subject) -> tuple[str, ...]:
    """Return what a recording holds while it runs: the rig, with all of its instruments."""
    return (rig_queue(campaign.rig),)


def with_a_rig(kind: Kind[P]) -> Kind[P]:
    """Return a kind that records with a rig: it has it for itself, and is never run again by itself."""
    return replace(
        kind,
        repeatable=never,
        queue=Queue.ACQUISITION,
        makes=MEASUREMENT,
        in_pipeline=False,
        devices=whole_rig,
        with_instruments=True,
    )


KIND = with_a_rig(
    Kind(
        name="acquire",
        summary="record every view of a state with the instruments of the rig",
        version=4,
        scope=Scope.STATE,
        parameters=AcquireParameters,
        inputs=(),
        outputs=(MEASURED, RECORDED, INTERRUPTED.by("number")),
        needs=no_needs,
        run=run,
        subjects=all_states,
        context=order,
    )
)
