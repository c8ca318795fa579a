"""How the frames of a measurement came in from real instruments."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.measurement import FrameStack, FringeSequence
from sms_jobs.records.quantity import array

PER_FRAME = ("frame",)


@dataclass(frozen=True)
class Verdict:
    """What can be said of a recording while the specimen is still held.

    Attributes
    ----------
    lit_fraction
        Part of the image that the projector lights: where fringes stand out from noise, or where white
        saturates.
    saturated_fraction
        Part of the lit region that is saturated in one of the fringe frames that were looked at.
    modulation
        Median of the fringes' amplitude in the lit region, as a fraction of full scale.
    doubts
        What an operator should know, in words; empty for a recording without blemish.
    """

    lit_fraction: float
    saturated_fraction: float
    modulation: float
    doubts: tuple[str, ...] = ()


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
        Scalar channels read before and after the set, by name, in the unit of their name.
    stage_rad
        Pan and tilt as the stage read them; None where there is none, or it had not been home.
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
    numbers: NDArray[np.int64] = array("1", "number that the camera gave the frame", PER_FRAME, kw_only=True)
    times_s: NDArray[np.float64] = array(
        "s", "time since the start of the recording", PER_FRAME, kw_only=True
    )


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
