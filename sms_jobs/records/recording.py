"""How the frames of a measurement came in from real instruments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from math import fsum

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.campaign import LoadState
from sms_jobs.records.measurement import FrameStack, FringeSequence
from sms_jobs.records.numbers import is_excessive
from sms_jobs.records.quantity import array

PER_FRAME = ("frame",)
STAGE_CHANNELS = ("pan_rad", "tilt_rad")
"""What the angles of a stage are called among the readings of a state."""


@dataclass(frozen=True)
class Verdict:
    """What can be said of a recording while the specimen is still held.

    Attributes
    ----------
    lit_fraction
        Part of the image that the projector lights: where fringes stand out from noise, or where white
        saturates. Without a projector, where texture stands out from noise.
    saturated_fraction
        Part of the lit region that is saturated in one of the fringe frames that were looked at, or in the
        image.
    modulation
        Median of the fringes' amplitude in the lit region, as a fraction of full scale; without fringes that
        of the texture's standard deviation.
    doubts
        What an operator should know, in words; empty for a recording without blemish.
    contrast_to_noise
        Of an image without fringes: the texture's standard deviation over that of noise; None for fringes.
    level
        Of an image without fringes: what 99 % of its pixels are below, as a fraction of full scale.
    """

    lit_fraction: float
    saturated_fraction: float
    modulation: float
    doubts: tuple[str, ...] = ()
    contrast_to_noise: float | None = None
    level: float | None = None


@dataclass(frozen=True)
class Recording:
    """How the frames of a measurement came in; it lies beside the measurement in its file.

    Attributes
    ----------
    rig
        Name of the rig whose file described the instruments.
    verdict
        Of the recording as it was kept.
    retaken
        How often a pattern was projected again because a camera missed it.
    recordings
        How many times the whole set was recorded; the last is the one that is kept.
    channels_before, channels_after
        Scalar channels read before and after the set, by name, in the unit of their name. Of a frame of a
        stream, what they read when it was exposed stands in the first, and nothing in the second.
    stage_rad
        Pan and tilt as the stage read them; None where there is none, or it had not been home.
    apart_s
        How far apart, at most, the cameras that recorded this state without a projector were exposed; None
        for fringes.
    numbers
        What each camera frame was numbered by the camera: fringe frames in order, then the white frame.
    times_s
        When each was taken, since the start of the recording.
    """

    rig: str
    verdict: Verdict
    retaken: int
    recordings: int
    channels_before: dict[str, float] = field(default_factory=dict)
    channels_after: dict[str, float] = field(default_factory=dict)
    stage_rad: tuple[float, float] | None = None
    apart_s: float | None = None
    numbers: NDArray[np.int64] = array("1", "number that the camera gave the frame", PER_FRAME, kw_only=True)
    times_s: NDArray[np.float64] = array(
        "s", "time since the start of the recording", PER_FRAME, kw_only=True
    )

    def readings(self) -> dict[str, float]:
        """Return what held while it was recorded, by name: the mean of what was read before and after it.

        What an instrument says when it is overloaded, such as 9.9e37, is no reading.
        """
        found = {
            name: 0.5 * (value + self.channels_after.get(name, value))
            for name, value in self.channels_before.items()
        }
        if self.stage_rad is not None:
            found |= zip(STAGE_CHANNELS, self.stage_rad, strict=True)
        return {name: value for name, value in found.items() if not is_excessive(value)}


@dataclass(frozen=True)
class FramesBetween:
    """Frames of a stream that lie beside the state before them, and measure nothing by themselves.

    Attributes
    ----------
    recorded_at
        Start of the stream.
    full_scale
        Grey level at which the camera saturates.
    numbers
        As in `Recording`.
    times_s
        When each was taken, since the start of the stream.
    frames
        In order.
    """

    recorded_at: datetime
    full_scale: int
    numbers: NDArray[np.int64] = array("1", "number that the camera gave the frame", PER_FRAME)
    times_s: NDArray[np.float64] = array("s", "time since the start of the stream", PER_FRAME)
    frames: FrameStack = array("count", "frames", ("frame", "row", "column"))


@dataclass(frozen=True)
class InterruptedRecording:
    """The frames of a set that broke off: every complete one is kept, but they measure nothing by themselves.

    Attributes
    ----------
    recorded_at
        Start of the recording.
    sequence
        What was to be recorded; `frames` are the first ones of it.
    full_scale
        Grey level at which the camera saturates.
    numbers, times_s
        As in `Recording`.
    frames
        The complete ones, in order.
    """

    recorded_at: datetime
    sequence: FringeSequence
    full_scale: int
    numbers: NDArray[np.int64] = array("1", "number that the camera gave the frame", PER_FRAME)
    times_s: NDArray[np.float64] = array("s", "time since the start of the recording", PER_FRAME)
    frames: FrameStack = array("count", "fringe frames", ("frame", "row", "column"))


def mean_readings(several: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the means of what several recordings of one state read, over those that read it."""
    names = dict.fromkeys(name for one in several for name in one)
    of = {name: [one[name] for one in several if name in one] for name in names}
    # Summed exactly, so that the order of the recordings does not matter.
    return {name: fsum(values) / len(values) for name, values in of.items()}


def as_recorded(state: LoadState, readings: Mapping[str, float]) -> LoadState:
    """Return a state with what was read while it was recorded, in place of what is known from elsewhere."""
    channels = dict(readings)
    return replace(
        state,
        measured_load_n=channels.pop("load_n", state.measured_load_n),
        measured_displacement_mm=channels.pop("displacement_mm", state.measured_displacement_mm),
        channels=state.channels | channels,
    )
