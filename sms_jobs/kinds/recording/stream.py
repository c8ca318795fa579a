"""Stream: the frames of cameras without a projector, as fast as they come, become states of a campaign.

It happens once. What has come into the spool when a stream breaks off is what there is of it: resumed, the
job archives that. Only where nothing has, because an event did not come, it begins anew.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Literal

import numpy as np
from pydantic import Field

from sms_jobs.errors import InstrumentError, InvalidInput
from sms_jobs.instruments.connection import connected
from sms_jobs.instruments.judging import APART_S, Limits, far_apart, judged_image, wanting
from sms_jobs.instruments.kept_sets import SIMULATION
from sms_jobs.instruments.kept_streams import KeptStream, Whole, kept_stream
from sms_jobs.instruments.simulated.optics import Setting
from sms_jobs.instruments.spool import Spooled, SpooledFrames
from sms_jobs.instruments.streaming import StreamOrder, stream
from sms_jobs.kinds.kind import (
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Progress,
    Scope,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import BETWEEN, MEASURED, RECORDED
from sms_jobs.kinds.recording.acquire import setting_at, station_of, statistics_of, with_a_rig
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.events import Event
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.optical_instruments import RigFile
from sms_jobs.records.recording import FramesBetween, Recording
from sms_jobs.records.sizes import number_of
from sms_jobs.records.statistic_names import SINCE_EVENT_S, SINCE_START_S, of_stream
from sms_jobs.records.streams import StreamSize, frame_label
from sms_jobs.records.subject import Subject

_STREAMING = 0.5
"""Part of the job's progress after which what was streamed is archived."""


class StreamParameters(Parameters):
    """How fast and how long cameras are streamed, and what of it is kept."""

    number: int = Field(
        0, ge=0, description="of the stream in its campaign, by which its states are labelled; 'sms acquire "
        "stream' gives it"
    )  # fmt: skip
    rate_hz: float = Field(1.0, gt=0.0, le=1e4, description="frames of each camera a second")
    for_s: float = Field(
        1.0, gt=0.0, description="how long is streamed, or how long the event is waited for, in s"
    )
    channel: str = Field("", description="of the event that is waited for; none to keep all")
    unit: str = Field("", description="of that channel")
    comes: Literal["above", "below", "drops"] = Field(
        "above", description="whether it has to go above the limit, below it, or drop by it"
    )
    limit: float = Field(0.0, description="in its unit")
    within_s: float = Field(1.0, gt=0.0, description="in which time it has to drop so far")
    before_s: float = Field(0.0, ge=0.0, description="what is kept before the event, in s")
    after_s: float = Field(0.0, ge=0.0, description="what is kept after the event, in s")
    every: int = Field(
        1,
        ge=1,
        description="every so manyth frame is a state; those between lie beside the state before them",
    )
    exposure: float = Field(1.0, gt=0.0, description="of every frame, in units of the cameras' own")
    lit_fraction: float = Field(
        0.01, ge=0.0, le=1.0, description="least part of the image in which texture must stand out"
    )
    saturated_fraction: float = Field(0.02, ge=0.0, le=1.0, description="most of that which may be saturated")
    apart_ms: float = Field(
        1e3 * APART_S, ge=0.0, description="how far apart the frames of a state may be that are to show one"
    )

    @property
    def event(self) -> Event | None:
        """What frames are kept around; None to keep all."""
        if not self.channel:
            return None
        return Event(self.channel, self.unit, self.comes, self.limit, self.within_s)

    @property
    def size(self) -> StreamSize:
        """How much it is."""
        if not self.channel:
            return StreamSize(self.rate_hz, self.for_s)
        return StreamSize(self.rate_hz, self.for_s, self.before_s, self.after_s)


@dataclass(frozen=True)
class Task:
    """What of a campaign is streamed.

    Attributes
    ----------
    cameras
        All of those that it records.
    setting
        What stands before simulated cameras: the specimen as in the reference state; None where nothing is.
    """

    cameras: tuple[str, ...]
    setting: Setting | None


def task(campaign: Campaign, subject: Subject) -> Task:
    """Return what is streamed."""
    return Task(campaign.recordings, setting_at(campaign, campaign.reference))


def campaigns_of_cameras(campaign: Campaign) -> tuple[Subject, ...]:
    """Return the campaign, if it tests a specimen by cameras alone: whose images are whole states."""
    return (Subject(campaign.name),) if campaign.session is None and not campaign.shows_fringes else ()


def needs(campaign: Campaign, subject: Subject, parameters: StreamParameters) -> Iterable[Need]:
    """Return no need; raise `InvalidInput` for a stream without a number, whose states would be others'."""
    if not parameters.number:
        raise InvalidInput("a stream has a number, which 'sms acquire stream' gives it: use that command")
    return ()


def require_exposures(rig: RigFile, cameras: Iterable[str], parameters: StreamParameters) -> None:
    """Raise `InvalidInput` for a rate that leaves no time for the exposure of a camera."""
    for camera in rig.cameras:
        exposure_s = camera.exposure_s * parameters.exposure
        if camera.name in cameras and exposure_s * parameters.rate_hz >= 1.0:
            raise InvalidInput(
                f"{camera.name} exposes for {1e3 * exposure_s:g} ms and cannot take {parameters.rate_hz:g} "
                f"frames a second: stay below {1.0 / exposure_s:.3g} Hz, or shorten its exposure_ms"
            )


def run(inputs: Inputs, parameters: StreamParameters, progress: Progress) -> Iterator[Output]:
    """Stream into the spool, unless frames are there, and yield what of it are states, camera by camera.

    Raises
    ------
    InvalidInput
        The rig's file lacks what is to be streamed with, or memory what is to wait in it.
    InstrumentError
        An instrument gives up, the event does not come, or no camera delivers together with the others.
    """
    of: Task = inputs.context
    station = station_of(inputs, of.setting)
    require_exposures(station.rig, of.cameras, parameters)
    kept = kept_stream(station.spool, of.cameras)
    if kept is None:
        shutil.rmtree(station.spool, ignore_errors=True)  # logs alone tell nothing
        order = StreamOrder(of.cameras, parameters.size, parameters.event, parameters.exposure)
        with connected(station.rig, of.setting, inputs.threads) as rig:
            stream(rig, order, station.spool, lambda f, words: progress(_STREAMING * f, words))
        kept = kept_stream(station.spool, of.cameras)
    if kept is None or not kept.whole():
        raise InstrumentError(_nothing(parameters, of.cameras))

    def archiving(fraction: float, words: str) -> None:
        progress(_STREAMING + (1.0 - _STREAMING) * fraction, words)

    yield from states_of(kept, inputs.subject.campaign, parameters, archiving)


def states_of(
    kept: KeptStream, campaign: str, parameters: StreamParameters, progress: Callable[[float, str], None]
) -> Iterator[DatasetOutput]:
    """Yield what of a stream are states of a campaign, camera by camera."""
    whole = kept.whole()
    states = whole[:: parameters.every]
    for number, (moment, following) in enumerate(zip(states, (*states[1:], None), strict=True), start=1):
        label = frame_label(parameters.number, number)
        progress((number - 1) / len(states), f"archiving {label}, of {number_of(len(states), 'state')}")
        for camera, file in kept.files.items():
            after = file.complete if following is None else following.places[camera]
            beside = range(moment.places[camera] + 1, after)
            first = range(moment.places[camera]) if number == 1 else range(0)
            between = {
                BETWEEN.of("before"): _frames(kept, camera, first),
                BETWEEN.of("after"): _frames(kept, camera, beside),
            }
            measurement, recording = _state(kept, camera, moment, parameters)
            statistics = statistics_of(recording) | _when(file, moment)
            if number == 1:
                statistics |= _account(kept, camera, len(whole))
            yield DatasetOutput(
                Subject(campaign, label, camera),
                {
                    MEASURED: measurement,
                    RECORDED: recording,
                    **{product: frames for product, frames in between.items() if frames is not None},
                },
                statistics,
            )
    progress(1.0, f"archived {number_of(len(states), 'state')}")


def _nothing(parameters: StreamParameters, cameras: Iterable[str]) -> str:
    if parameters.event is not None:
        return (
            f"{parameters.event} did not come within {parameters.for_s:g} s, and no frame was kept: 'sms "
            "acquire resume' waits again, 'sms acquire abort' gives it up"
        )
    return f"{', '.join(cameras)} delivered no frames of one moment: look at their links and triggers"


def _state(
    kept: KeptStream, camera: str, moment: Whole, parameters: StreamParameters
) -> tuple[Measurement, Recording]:
    """Return what a frame measures at its moment, and how it came in."""
    file, place = kept.files[camera], moment.places[camera]
    about = file.header.about
    numbers, times = kept.counted[camera]
    limits = Limits(
        parameters.saturated_fraction, parameters.lit_fraction, apart_s=1e-3 * parameters.apart_ms
    )
    verdict = judged_image(file, speckled=True, place=place)
    doubts = [*wanting(verdict, limits), *far_apart(tuple(kept.files), moment.apart_s, limits)]
    measurement = Measurement(
        file.header.recorded_at + timedelta(seconds=moment.time_s),
        FringeSequence(),
        about["full_scale"],
        about["gain"],
        about["read_noise"],
        file.frame(place).astype(np.uint16),
        SpooledFrames(file, 1, place),
        None if about["simulation"] is None else SIMULATION.validate_python(about["simulation"]),
    )
    recording = Recording(
        about["rig"],
        replace(verdict, doubts=tuple(f"{camera}: {words}" for words in doubts)),
        0,
        1,
        kept.values_at(moment.time_s),
        apart_s=moment.apart_s,
        numbers=numbers[place : place + 1],
        times_s=times[place : place + 1] - moment.time_s,
    )
    return measurement, recording


def _when(file: Spooled, moment: Whole) -> dict[str, float]:
    """Return when a state was in its stream: since its start, and since the event."""
    event_s = file.header.about["event_s"]
    since = {} if event_s is None else {SINCE_EVENT_S: moment.time_s - event_s}
    return {SINCE_START_S: moment.time_s, **since}


def _account(kept: KeptStream, camera: str, whole: int) -> dict[str, float]:
    """Return what became of the frames of a camera; it stands with the first state of the stream."""
    account = kept.account(camera)
    return {
        of_stream("moments"): float(account.moments),
        of_stream("whole"): float(whole),
        of_stream("late"): float(account.late),
        of_stream("lost"): float(account.lost),
        of_stream("refused"): float(account.refused),
        of_stream("broke_off"): float(not kept.ended),
    }


def _frames(kept: KeptStream, camera: str, places: range) -> FramesBetween | None:
    """Return some frames that are no states; None for none."""
    if not places:
        return None
    file, (numbers, times) = kept.files[camera], kept.counted[camera]
    part = slice(places.start, places.stop)
    return FramesBetween(
        file.header.recorded_at,
        file.header.about["full_scale"],
        numbers[part],
        times[part],
        SpooledFrames(file, len(places), places.start),
    )


KIND = with_a_rig(
    Kind(
        name="stream",
        summary="record cameras without a projector at a rate; their frames become states",
        version=2,
        scope=Scope.CAMPAIGN,
        parameters=StreamParameters,
        inputs=(),
        outputs=(MEASURED, RECORDED, BETWEEN.by("before or after")),
        needs=needs,
        run=run,
        subjects=campaigns_of_cameras,
        context=task,
        adds_states=True,
    )
)
