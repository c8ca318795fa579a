"""Frames of a tuple at some of its pixels, what is told of them, and what they hold of their neighbours."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.shape.foreign_patterns import coarse_gradient, offsets_of
from sms_jobs.metrology.phase.frame_fit import FrameFit, SampledFrames, fit_frames
from sms_jobs.metrology.phase.frame_lag import NEIGHBOURS, FrameLag, Neighbour, find_lag, without_lag
from sms_jobs.records.measurement import Measurement

LEAST_PIXELS = 200
"""That are lit: of fewer nothing is said."""
_SURE = 6.0  # standard deviations
_TRIED = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5)  # beyond, nothing is told apart
_EXPLAINED, _LEFT = 0.5, 0.5  # of the pixels agree, and of the misfit is left at most
_ONE_SURFACE = 0.9  # of the pixels agree
_LEAST = 0.02  # that explains why they do not


@dataclass(frozen=True)
class OtherLight:
    """What frames hold besides their patterns and noise.

    Attributes
    ----------
    lag
        What they are sure to hold of the light of a neighbour; None for nothing.
    excess
        (orientations,): variance that phases have besides noise otherwise, in units of that; empty if nobody
        knows.
    """

    lag: FrameLag | None = None
    excess: tuple[float, ...] = ()


def frame_places(measurement: Measurement, count: int) -> list[NDArray[np.intp]]:
    """Return the numbers of the frames of each orientation without the density 0, among `count` patterns."""
    sequence, every = measurement.sequence, np.arange(count)
    return [every[sequence.frames_of(k, uniform=False)] for k in range(len(sequence.orientations_rad))]


@dataclass(frozen=True)
class WatchedFrames:
    """What was seen of all patterns of a measurement at some lit pixels.

    Attributes
    ----------
    measurement
        What is told of it.
    levels
        (patterns, pixels), grey levels of the camera's own type, in the order of recording.
    accepted_rad
        Phase error of the fringes themselves that is accepted.
    ranged
        Whether pixels may see several surfaces.
    """

    measurement: Measurement
    levels: NDArray[Any]
    accepted_rad: float
    ranged: bool

    @property
    def places(self) -> list[NDArray[np.intp]]:
        """Those of `frame_places`."""
        return frame_places(self.measurement, len(self.levels))

    @property
    def densities(self) -> tuple[float, ...]:
        """Those of the fringes, without the density 0."""
        return tuple(t for t in self.measurement.sequence.densities if t)

    @cached_property
    def told(self) -> tuple[SampledFrames, ...]:
        """The frames of each orientation, and what they are said to show."""
        return tuple(
            SampledFrames(
                self.levels[own],
                self.densities,
                self.measurement.sequence.steps,
                self.measurement.grey_levels,
                self.accepted_rad,
                offsets_of(self.measurement),
                self.ranged,
                coarse_gradient(self.measurement, k, self.levels[:, None]),
            )
            for k, own in enumerate(self.places)
        )

    @cached_property
    def fits(self) -> tuple[FrameFit, ...]:
        """How well they are explained by that."""
        return tuple(map(fit_frames, self.told))

    @property
    def share(self) -> float:
        """Part of the pixels whose phases agree, of the worse orientation."""
        return min(fit.share for fit in self.fits)

    @property
    def misfit(self) -> float:
        """What they leave, in units of noise and of what is accepted, of all orientations."""
        return sum(fit.total for fit in self.fits)

    def other_light(self) -> OtherLight:
        """Return what frames hold besides their patterns and noise; nothing where hardly a pixel tells."""
        within = self.levels.max(axis=0) < self.measurement.grey_levels.full_scale
        if not within.all():
            # What is cut off at full scale looks like light that is missing.
            some = np.count_nonzero(within) >= LEAST_PIXELS
            return replace(self, levels=self.levels[:, within]).other_light() if some else OtherLight()
        sure = [one for one in self._lags if one.part > _SURE * one.sigma]
        lag = max(sure, key=lambda one: one.explained, default=None)
        apart = self if lag is None else self._without(lag.part, lag.neighbour)
        # What a pixel sees of a second surface is no excess.
        one_surface = not self.ranged or apart.share > _ONE_SURFACE
        return OtherLight(lag, tuple(fit.excess for fit in apart.fits) if one_surface else ())

    @property
    def suspected(self) -> float:
        """The larger part of a neighbour's light that the frames seem to hold, sure or not."""
        return max(one.part for one in self._lags)

    def explaining_lag(self) -> tuple[float, Neighbour, WatchedFrames] | None:
        """Return the part of a neighbour's light without which frames that do not agree do, and them then.

        None where there is no such part.
        """
        tried = (
            (self._without(part, neighbour), part, neighbour) for neighbour in NEIGHBOURS for part in _TRIED
        )
        apart, part, neighbour = min(tried, key=lambda one: one[0].misfit)
        if apart.share < _EXPLAINED or apart.misfit > _LEFT * self.misfit:
            return None
        part += (1.0 - part) * apart._lags[NEIGHBOURS.index(neighbour)].part
        return (part, neighbour, self._without(part, neighbour)) if _LEAST < part < 1.0 else None

    @cached_property
    def _lags(self) -> tuple[FrameLag, ...]:
        """What is found of each neighbour."""
        levels = self.levels.astype(np.float32)
        return tuple(find_lag(self.fits, levels, self.places, neighbour) for neighbour in NEIGHBOURS)

    def _without(self, part: float, neighbour: Neighbour) -> WatchedFrames:
        """Return the frames without the part that each holds of a neighbour."""
        apart = without_lag(self.levels.astype(np.float32), part, neighbour)
        most = self.measurement.grey_levels.full_scale
        return replace(self, levels=np.clip(np.rint(apart), 0, most).astype(self.levels.dtype))
