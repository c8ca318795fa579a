"""What a view records at a state: a fringe sequence and its frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from math import inf, pi
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.records.quantity import array
from sms_jobs.records.scene import Simulation


@dataclass(frozen=True)
class FringeSequence:
    """The patterns that a projector shows, in order: orientations, then densities, then phase steps.

    All of them are recorded with one exposure after the other, the frames of an exposure together.

    Attributes
    ----------
    densities
        Number of fringes across the projector, in the order of projection; thesis default
        (32, 31, 30, 28, 24, 16). The density 0 is a uniform field, see `steps_of`.
    steps
        Phase steps a density, at least 3.
    orientations_rad
        Direction in which the phase grows, from the projector's x axis towards its y axis: 0 gives
        vertical fringes, pi/2 horizontal ones.
    exposures
        Exposure times in units of the camera's own, in the order of recording: several for a surface whose
        brightness spans more than the camera's range.
    """

    densities: tuple[int, ...] = (32, 31, 30, 28, 24, 16)
    steps: int = 4
    orientations_rad: tuple[float, ...] = (0.0, pi / 2)
    exposures: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        if self.steps < 3:
            raise InvalidInput(f"a fringe sequence needs at least 3 phase steps, not {self.steps}")
        if not self.densities or min(self.densities) < 0 or max(self.densities) == 0:
            raise InvalidInput(
                f"fringe densities must be at least 1, or 0 beside others, not {self.densities}"
            )
        if self.densities.count(0) > 1:
            raise InvalidInput("the fringe density 0 is shown once at most: it is the same field every time")
        if not self.orientations_rad:
            raise InvalidInput("a fringe sequence needs at least one orientation")
        if not self.exposures or not all(0.0 < e < inf for e in self.exposures):
            raise InvalidInput(
                f"a fringe sequence needs one exposure or several, each above 0 times the camera's own, not "
                f"{self.exposures}"
            )
        if len(set(self.exposures)) < len(self.exposures):
            raise InvalidInput(f"a fringe sequence has each exposure once, not {self.exposures}: omit one")

    @property
    def frames(self) -> int:
        """Number of fringe frames of the whole sequence, all exposures together."""
        return len(self.exposures) * self.frames_per_exposure

    @property
    def frames_per_exposure(self) -> int:
        """Number of fringe frames of one exposure: of the patterns that are shown."""
        return len(self.orientations_rad) * sum(len(self.steps_of(t)) for t in self.densities)

    def steps_of(self, density: int) -> tuple[int, ...]:
        """Return the phase steps that are shown of a density, in order.

        Of a uniform field the brightest and the darkest alone, 0 and steps // 2: the others add nothing to
        its amplitude. The sequence 0 .. s-1 of Fourier domain ranging thus has 4 s - 2 frames for an
        orientation (thesis section 7.2.2).
        """
        return tuple(range(self.steps)) if density else (0, self.steps // 2)

    def frames_of(self, orientation: int, uniform: bool = True) -> NDArray[np.intp] | slice:
        """Return where the frames of an orientation are, by its number, with or without the density 0.

        They are counted among those of one exposure, in the order of `patterns`.
        """
        count = self.frames_per_exposure // len(self.orientations_rad)
        start = orientation * count
        if uniform or 0 not in self.densities:
            return slice(start, start + count)
        if self.densities[0] == 0:
            return slice(start + 2, start + count)
        shown = [t > 0 for t in self.densities for _ in self.steps_of(t)]
        return start + np.flatnonzero(shown)

    def patterns(self) -> Iterator[tuple[float, int, int]]:
        """Yield (orientation in rad, density, step 0 .. steps-1) of each frame of an exposure in order."""
        for orientation in self.orientations_rad:
            for density in self.densities:
                for step in self.steps_of(density):
                    yield orientation, density, step


class FrameStack(Protocol):
    """Frames that may lie in memory, in a file, or be made as they are asked for."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames, rows, columns)."""
        ...

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 or uint16."""
        ...

    def frame(self, index: int) -> NDArray[Any]:
        """Return one frame, (rows, columns)."""
        ...

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        ...


@dataclass(frozen=True)
class ArrayStack:
    """Frames in memory.

    Attributes
    ----------
    frames
        (frames, rows, columns), uint8 or uint16.
    """

    frames: NDArray[Any]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames, rows, columns)."""
        count, rows, columns = self.frames.shape
        return count, rows, columns

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of one grey level."""
        return self.frames.dtype

    def frame(self, index: int) -> NDArray[Any]:
        """Return one frame, (rows, columns)."""
        frame: NDArray[Any] = self.frames[index]
        return frame

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        return self.frames[:, start:stop]


@dataclass(frozen=True)
class GrayCode:
    """Stripe patterns that were recorded beside the fringes: they tell the fringe order.

    Attributes
    ----------
    bits
        Patterns of each orientation, the coarsest first.
    stripes
        How many stripes go across the projector; 2^bits where they fill it.
    threshold
        Above which grey level a bit is set: that of the inverse pattern, the mean of the white and the black
        frame, or the mean of the pixel's fringe frames.
    """

    bits: int
    stripes: float
    threshold: Literal["inverse", "white-black", "fringes"] = "fringes"

    def frames(self, orientations: int) -> int:
        """Return how many frames there are: orientation by orientation, inverse patterns behind the others.

        White and black come last, once for all orientations.
        """
        each = 2 * self.bits if self.threshold == "inverse" else self.bits
        return orientations * each + (2 if self.threshold == "white-black" else 0)


@dataclass(frozen=True)
class Measurement:
    """What one view recorded at one state.

    Attributes
    ----------
    recorded_at
        Start of the recording, with time zone.
    sequence
        The patterns that were projected.
    full_scale
        Grey level at which the camera saturates, e.g. 4095.
    gain, read_noise
        Noise model of the camera in grey levels: variance = read_noise^2 + gain * grey level.
    texture
        White frame: the projector at full brightness and no fringes, at the camera's own exposure, 1,
        whatever the exposures of the fringes: what is correlated has one noise model.
    frames
        Fringe frames in the order of `sequence.patterns()`, exposure by exposure; streamed.
    simulation
        For a virtual rig: what was simulated.
    dimming
        By which factor the projector's brightness was lowered, pixel by pixel of its image, in the patterns
        and in the white frame; None for full brightness.
    phase_offsets_rad
        What the patterns of a foreign projector add to the phase omega t, by density; empty for nothing.
    gray_code
        Of a foreign projector: the code that was shown beside the fringes; None for none.
    code_frames
        The frames of that code, in the order of `GrayCode.frames`; streamed.
    """

    recorded_at: datetime
    sequence: FringeSequence
    full_scale: int
    gain: float
    read_noise: float
    texture: NDArray[np.uint16] = array("count", "white-light texture")
    frames: FrameStack = array("count", "fringe frames", ("frame", "row", "column"))
    simulation: Simulation | None = None
    dimming: NDArray[np.float32] | None = array(
        "1", "factor by which the projector's pixels were dimmed", default=None
    )
    phase_offsets_rad: tuple[float, ...] = ()
    gray_code: GrayCode | None = None
    code_frames: FrameStack | None = array(
        "count", "frames of the Gray code", ("frame", "row", "column"), default=None
    )

    @property
    def grey_levels(self) -> GreyLevels:
        """What the camera's grey levels mean."""
        return GreyLevels(self.full_scale, self.gain, self.read_noise)

    def noise(self, level: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the standard deviation of one frame's noise at grey levels."""
        return np.asarray(np.sqrt(self.read_noise**2 + self.gain * level))
