"""Projectors of a scanner that has a computer of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.instruments.optical_drivers import DriverContext, ProjectorDriver
from sms_jobs.instruments.scanners.client import link_to, links
from sms_jobs.instruments.scanners.lent import LentInstrument
from sms_jobs.instruments.scanners.link import DEFORMATION, SEQUENCE, ScannerLink
from sms_jobs.instruments.simulated.optics import WHITE, VirtualRoom
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import ProjectorInstrument


@dataclass(frozen=True)
class ScannerProjectorSettings(ProjectorInstrument, LentInstrument):
    """A projector that `sms rig serve` lends.

    Attributes
    ----------
    settle_ms
        Of a picture, for a dry run alone; what holds is said in the scanner's own rig file.
    """

    driver: Literal["scanner"]
    settle_ms: float = 0.0


@dataclass
class ScannerProjector:
    """A projector at the other end of a link."""

    name: str
    link: ScannerLink
    settings: ScannerProjectorSettings
    scanners: Mapping[tuple[str, str], ScannerLink]
    room: VirtualRoom | None = None
    _sequence: FringeSequence = field(default_factory=FringeSequence)

    def describe(self) -> str:
        """Return what it is."""
        return self.settings.described(self.link)

    def load(self, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None) -> None:
        """Make ready for the patterns of a sequence; raise `InvalidInput` where its light is to be dimmed."""
        if dimming is not None:
            raise InvalidInput(
                f"projector {self.name} belongs to the scanner at {self.settings.server}, to which no "
                "dimming is sent: record with adaptive=exposures"
            )
        self._sequence = sequence
        self.link.ask("load", projector=self.name, sequence=self._sequence_message)
        if self.room is not None:
            # What a stage has moved stands elsewhere than when the scanners were connected.
            stands = DEFORMATION.dump_python(self.room.present_deformation(), mode="json")
            for link in self.scanners.values():
                if link.simulated:
                    link.ask("stands", deformation=stands)

    def show(self, number: int) -> None:
        """Show a pattern; it is on when this returns."""
        self._show(range(self._sequence.frames_per_exposure)[number])

    def white(self) -> None:
        """Show full brightness."""
        self._show(WHITE)

    def dark(self) -> None:
        """Show nothing."""
        self.link.ask("dark", projector=self.name)
        self._tell_others(None)

    def _show(self, number: int) -> None:
        self._tell_others(number)
        self.link.ask("show", projector=self.name, number=number)

    def _tell_others(self, number: int | None) -> None:
        """Let the light fall into the other scanners' cameras, where it is not real."""
        for link in self.scanners.values():
            if link is not self.link and link.simulated:
                link.ask("elsewhere", projector=self.name, sequence=self._sequence_message, number=number)

    @property
    def _sequence_message(self) -> object:
        return SEQUENCE.dump_python(self._sequence, mode="json")


def connect(settings: ScannerProjectorSettings, context: DriverContext) -> ScannerProjector:
    """Connect the scanner, once for all of its sensors."""
    link = link_to(settings.server, settings.key_file, context)
    return ScannerProjector(settings.name, link, settings, links(context), context.room)


DRIVER = ProjectorDriver("scanner", ScannerProjectorSettings, connect)
