"""Patterns that a projector plays by itself, while its pulses expose the cameras."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from sms_jobs.errors import InvalidInput


@dataclass(frozen=True)
class PulseTrain:
    """The pulses of a projector that plays patterns by itself: one at the beginning of each pattern.

    Attributes
    ----------
    cameras
        That a wire carries them to.
    period_ms
        From one pattern to the next, where no camera needs longer.
    lead_ms
        From the start to the first pattern.
    """

    cameras: tuple[str, ...]
    period_ms: float
    lead_ms: float = 0.0

    def __post_init__(self) -> None:
        if not self.cameras or len(set(self.cameras)) < len(self.cameras):
            raise InvalidInput(
                f"pulses are wired to cameras, each named once, not to '{', '.join(self.cameras)}'"
            )
        if not (0.0 < self.period_ms <= 60e3 and 0.0 <= self.lead_ms <= 60e3):
            raise InvalidInput(
                f"pulses have a period above 0 and a lead from 0 to 60000 ms, not {self.period_ms} and "
                f"{self.lead_ms} ms"
            )

    def missing(self, cameras: Collection[str]) -> tuple[str, ...]:
        """Return those of some cameras that no wire carries the pulses to."""
        return tuple(name for name in cameras if name not in self.cameras)


@dataclass(frozen=True)
class Burst:
    """What is played and exposed without a word in between, once everybody is ready.

    Attributes
    ----------
    frames
        How many patterns, pulses, and frames of each camera.
    exposure
        In units of the cameras' own.
    period_s
        From one pulse to the next.
    lead_s
        From the start to the first pulse.
    lit_s
        How long each pattern is lit: as long as the cameras expose, since projectors make grey levels of
        mirrors that are on for a part of that time; 0 where the cameras' files do not say it.
    """

    frames: int
    exposure: float
    period_s: float
    lead_s: float = 0.0
    lit_s: float = 0.0

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return self.lead_s + self.frames * self.period_s
