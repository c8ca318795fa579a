"""What a view records at a state: a fringe sequence and its frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from math import inf, lcm, pi
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.records.gray_code import GrayCode, Stripes
from sms_jobs.records.quantity import array
from sms_jobs.records.scene import Simulation

LARGEST_STEPS = 4096
"""Most phase steps of a density: a frame for each grey level of a camera of 12 bits."""


@dataclass(frozen=True)
class FringeSequence:
    """The patterns that a projector shows, in order: orientations, then densities, then phase steps.

    Those of a Gray code follow the fringes. All of them are recorded with one exposure after the other, the
    frames of an exposure together.

    Attributes
    ----------
    densities
        Number of fringes across the projector, in the order of projection, whole or not; thesis default
        (32, 31, 30, 28, 24, 16). The density 0 is a uniform field, see `steps_of`.
    steps
        Phase steps a density, at least 3: step k adds 2 pi k / steps.
    orientations_rad
        Direction in which the phase grows, from the projector's x axis towards its y axis: 0 gives
        vertical fringes, pi/2 horizontal ones.
    exposures
        Exposure times in units of the camera's own, in the order of recording: several for a surface whose
        brightness spans more than the camera's range.
    shown
        Which of the steps are shown of each density, where some have fewer than three: all densities then
        share one mean and one modulation, as in micro and embedded phase shifting. Empty for all of them.
    gray
        A Gray code beside the fringes, or without any: then there are no densities. None for fringes alone.
    """

    densities: tuple[int | float, ...] = (32, 31, 30, 28, 24, 16)
    steps: int = 4
    orientations_rad: tuple[float, ...] = (0.0, pi / 2)
    exposures: tuple[float, ...] = (1.0,)
    shown: tuple[tuple[int, ...], ...] = ()
    gray: GrayCode | None = None

    def __post_init__(self) -> None:
        if self.steps < 3:
            raise InvalidInput(f"a fringe sequence needs at least 3 phase steps, not {self.steps}")
        if self.steps > LARGEST_STEPS:
            raise InvalidInput(f"a fringe sequence has {LARGEST_STEPS} phase steps at most, not {self.steps}")
        below = [t for t in self.densities if not (t == 0 or 1 <= t < inf)]
        needed = self.densities or self.gray is None
        if below or (needed and max(self.densities, default=0) == 0):
            raise InvalidInput(
                f"fringe densities must be at least 1, or 0 beside others, not {self.densities}"
            )
        if self.gray is not None and (self.gray.threshold == "fringes") > bool(self.densities):
            raise InvalidInput(
                "a Gray code without fringes needs the inverse of each pattern, or white and black, to "
                "distinguish bright from dark"
            )
        if self.shown:
            self._check_shown()
        if self.densities.count(0) > 1:
            raise InvalidInput("the fringe density 0 is shown once at most: it is the same field every time")
        if not self.orientations_rad:
            raise InvalidInput("a fringe sequence needs at least one orientation")
        if self.gray is not None and len(self.gray.stripes) not in (1, len(self.orientations_rad)):
            raise InvalidInput(
                f"a Gray code has one number of stripes, or one for each of the {len(self.orientations_rad)} "
                f"orientations, not {len(self.gray.stripes)}"
            )
        if not self.exposures or not all(0.0 < e < inf for e in self.exposures):
            raise InvalidInput(
                f"a fringe sequence needs one exposure or several, each above 0 times the camera's own, not "
                f"{self.exposures}"
            )
        if len(set(self.exposures)) < len(self.exposures):
            raise InvalidInput(f"a fringe sequence has each exposure once, not {self.exposures}: omit one")

    @classmethod
    def with_counts(
        cls,
        densities: tuple[int | float, ...],
        counts: int | tuple[int, ...],
        orientations_rad: tuple[float, ...],
        exposures: tuple[float, ...] = (1.0,),
        gray: GrayCode | None = None,
    ) -> FringeSequence:
        """Return a sequence from one number of steps, or from one for each density.

        Three steps or more are equal parts of a turn, two are 0 and a quarter, one is 0. Raises
        `InvalidInput` for a list of another length, and as the sequence itself does.
        """
        if isinstance(counts, int):
            return cls(densities, counts, orientations_rad, exposures, gray=gray)
        if not counts or len(counts) != len(densities) or min(counts) < 1:
            raise InvalidInput(
                f"steps should be one number, or one for each of the {len(densities)} densities and at "
                f"least 1, not {list(counts)}"
            )
        if len(set(counts)) == 1 and counts[0] > 2:
            return cls(densities, counts[0], orientations_rad, exposures, gray=gray)
        steps = lcm(*(4 if n == 2 else n for n in counts))
        parts = [range(0, steps // 2, steps // 4) if n == 2 else range(0, steps, steps // n) for n in counts]
        return cls(densities, max(steps, 3), orientations_rad, exposures, tuple(map(tuple, parts)), gray)

    def _check_shown(self) -> None:
        """Raise `InvalidInput` where the steps that are shown cannot tell mean, modulation and phase."""
        if len(self.shown) != len(self.densities) or not all(
            steps and len(set(steps)) == len(steps) and set(steps) <= set(range(self.steps))
            for steps in self.shown
        ):
            raise InvalidInput(
                f"of each of the {len(self.densities)} densities some of the steps 0 .. {self.steps - 1} "
                f"have to be shown, each once, not {self.shown}"
            )
        if 0 in self.densities or len(set(self.densities)) < len(self.densities):
            raise InvalidInput(
                "densities that share their modulation are all different and above 0, not "
                f"{', '.join(map(str, self.densities))}"
            )
        if not any(self._evenly(steps) for steps in self.shown) or sum(map(len, self.shown)) < 4:
            raise InvalidInput(
                "one density at least needs three phase steps or more, and the others one or more, as in "
                f"steps = [3, 1, 1]; not {', '.join(str(len(steps)) for steps in self.shown)}"
            )

    def _evenly(self, steps: tuple[int, ...]) -> bool:
        """Say whether steps are three or more equal parts of a turn."""
        parts = sorted((k - steps[0]) * len(steps) % (self.steps * len(steps)) for k in steps)
        return len(steps) > 2 and parts == [self.steps * i for i in range(len(steps))]

    @property
    def joint(self) -> bool:
        """Whether the frames of all densities tell one mean and one modulation together."""
        return bool(self.shown)

    @property
    def striped(self) -> bool:
        """Whether a Gray code is all there is."""
        return not self.densities

    @property
    def anchor(self) -> int:
        """Place of the density with the most equal steps, which by itself tells mean and modulation."""
        evenly = [len(steps) if self._evenly(steps) else 0 for steps in self.shown]
        return evenly.index(max(evenly)) if self.shown else next(i for i, t in enumerate(self.densities) if t)

    @property
    def anchor_steps(self) -> int:
        """How many steps that density has; 2 of a Gray code alone, bright and dark."""
        if self.striped:
            return 2
        return len(self.steps_of(self.densities[self.anchor]))

    @property
    def counts(self) -> int | tuple[int, ...]:
        """How many steps there are, of each density where they differ."""
        return tuple(len(steps) for steps in self.shown) or self.steps

    @property
    def in_words(self) -> str:
        """What is shown: densities 16, 1 x 4 steps, or densities 70.5, 66, 64 x 3, 1, 1 steps."""
        code = "" if self.gray is None else self.gray.in_words
        if self.striped:
            return code
        counts = ", ".join(str(len(steps)) for steps in self.shown) or str(self.steps)
        fringes = f"densities {', '.join(f'{t:g}' for t in self.densities)} x {counts} steps"
        return f"{fringes} with {code}" if code else fringes

    @property
    def frames(self) -> int:
        """Number of frames of the whole sequence, all exposures together."""
        return len(self.exposures) * self.frames_per_exposure

    @property
    def frames_per_exposure(self) -> int:
        """Number of frames of one exposure: of the patterns that are shown."""
        code = 0 if self.gray is None else self.gray.frames(len(self.orientations_rad))
        return len(self.orientations_rad) * self._fringes_each + code

    @property
    def _fringes_each(self) -> int:
        """Number of fringe frames of one exposure and orientation."""
        return sum(len(self.steps_of(t)) for t in self.densities)

    @property
    def averaged_frames(self) -> int:
        """Number of frames of one exposure that the mean intensity is the mean of."""
        if self.gray is not None and self.striped:
            return 2 if self.gray.threshold == "white-black" else self.frames_per_exposure
        return len(self.orientations_rad) * self._fringes_each

    def steps_of(self, density: float) -> tuple[int, ...]:
        """Return the phase steps that are shown of a density, in order.

        Of a uniform field the brightest and the darkest alone, 0 and steps // 2: the others add nothing to
        its amplitude. The sequence 0 .. s-1 of Fourier domain ranging thus has 4 s - 2 frames for an
        orientation (thesis section 7.2.2).
        """
        if self.shown:
            return self.shown[self.densities.index(density)]
        return tuple(range(self.steps)) if density else (0, self.steps // 2)

    def frames_of(self, orientation: int, uniform: bool = True) -> NDArray[np.intp] | slice:
        """Return where the fringes of an orientation are, by its number, with or without the density 0.

        They are counted among the frames of one exposure, in the order of `patterns`.
        """
        count = self._fringes_each
        start = orientation * count
        if uniform or 0 not in self.densities:
            return slice(start, start + count)
        if self.densities[0] == 0:
            return slice(start + 2, start + count)
        shown = [t > 0 for t in self.densities for _ in self.steps_of(t)]
        return start + np.flatnonzero(shown)

    def frames_of_anchor(self, orientation: int) -> slice:
        """Return where the frames are that tell mean and modulation, as `frames_of` does.

        Of fringes those of the anchor, of a Gray code alone a pattern and its inverse, or white and black.
        """
        if self.gray is not None and self.striped:
            plain = self.gray.threshold == "white-black"
            start = self.frames_per_exposure - 2 if plain else self.code_frames_of(orientation).start
            return slice(start, start + 2)
        count = self._fringes_each
        before = sum(len(self.steps_of(t)) for t in self.densities[: self.anchor])
        start = orientation * count + before
        return slice(start, start + self.anchor_steps)

    def whole_turns_of(self, orientation: int) -> NDArray[np.intp] | slice:
        """Return where the frames are whose patterns cancel in the mean over steps, as `frames_of` does."""
        if self.gray is not None and self.striped:
            own = self.code_frames_of(orientation)
            return own if self.gray.threshold == "inverse" else self.frames_of_anchor(orientation)
        if self.joint:
            return self.frames_of_anchor(orientation)
        return self.frames_of(orientation, uniform=False)

    def code_frames_of(self, orientation: int) -> slice:
        """Return where the frames of the Gray code of an orientation are, as `frames_of` does."""
        each = 0 if self.gray is None else self.gray.frames_each
        start = len(self.orientations_rad) * self._fringes_each + orientation * each
        return slice(start, start + each)

    def code_patterns(self) -> Iterator[Stripes]:
        """Yield the patterns of the Gray code in order; in an exposure they follow the fringes."""
        if self.gray is None:
            return
        bits = self.gray.bits
        each = [(angle, bits, self.gray.stripes_of(k)) for k, angle in enumerate(self.orientations_rad)]
        for about in each:
            for bit in range(bits):
                yield Stripes(*about, bit)
                if self.gray.threshold == "inverse":
                    yield Stripes(*about, bit, inverted=True)
        if self.gray.threshold == "white-black":
            yield Stripes(*each[0], None)
            yield Stripes(*each[0], None, inverted=True)

    def patterns(self) -> Iterator[tuple[float, float, int]]:
        """Yield (orientation in rad, density, step 0 .. steps-1) of each fringe frame of an exposure."""
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
        In the order of `sequence.patterns()`, then of `sequence.code_patterns()`, exposure by exposure;
        streamed.
    simulation
        For a virtual rig: what was simulated.
    dimming
        By which factor the projector's brightness was lowered, pixel by pixel of its image, in the patterns
        and in the white frame; None for full brightness.
    phase_offsets_rad
        What the patterns of a foreign projector add to the phase omega t, by density; empty for nothing.
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

    @property
    def grey_levels(self) -> GreyLevels:
        """What the camera's grey levels mean."""
        return GreyLevels(self.full_scale, self.gain, self.read_noise)

    def noise(self, level: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the standard deviation of one frame's noise at grey levels."""
        return np.asarray(np.sqrt(self.read_noise**2 + self.gain * level))
