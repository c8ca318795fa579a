"""The lamp of a virtual rig: it lights the scene for cameras of this computer and of simulated scanners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sms_jobs.instruments.scanners.link import DEFORMATION, SEQUENCE, ScannerLink
from sms_jobs.instruments.simulated.optics import LAMP, WHITE, VirtualRoom
from sms_jobs.records.measurement import FringeSequence


@dataclass(frozen=True)
class RoomLamp:
    """A lamp in a room, and in those of the simulated scanners that stand in it.

    Attributes
    ----------
    room
        What its light falls into.
    scanners
        All that the rig is connected to; real ones are not told.
    """

    room: VirtualRoom
    scanners: Mapping[tuple[str, str], ScannerLink]

    def on(self) -> None:
        """Light the scene."""
        self.room.light(LAMP, FringeSequence(), WHITE)
        # What a stage has moved stands elsewhere than when the scanners were connected.
        stands = DEFORMATION.dump_python(self.room.present_deformation(), mode="json")
        for link in self._simulated():
            link.ask("stands", deformation=stands)
        self._tell(WHITE)

    def off(self) -> None:
        """Light it no more."""
        self.room.darken(LAMP)
        self._tell(None)

    def _tell(self, number: int | None) -> None:
        sequence = SEQUENCE.dump_python(FringeSequence(), mode="json")
        for link in self._simulated():
            link.ask("elsewhere", projector=LAMP, sequence=sequence, number=number)

    def _simulated(self) -> list[ScannerLink]:
        return [link for link in self.scanners.values() if link.simulated]
