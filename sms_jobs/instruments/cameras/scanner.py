"""Cameras of a scanner that has a computer of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.instruments.optical_drivers import CameraDriver, DriverContext
from sms_jobs.instruments.protocols import CameraFacts, Fired, Frame
from sms_jobs.instruments.scanners.client import link_to
from sms_jobs.instruments.scanners.lent import LentInstrument
from sms_jobs.instruments.scanners.link import ScannerLink
from sms_jobs.records.optical_instruments import CameraInstrument

_TRANSFER_S = 10.0
"""What a frame may take through the network, when it is there."""


@dataclass(frozen=True)
class ScannerCameraSettings(CameraInstrument, LentInstrument):
    """A camera that `sms rig serve` lends.

    Attributes
    ----------
    exposure_ms
        Of an exposure of 1, for a dry run alone; what holds is said in the scanner's own rig file.
    """

    driver: Literal["scanner"]
    exposure_ms: float = 0.0


@dataclass
class ScannerCamera:
    """A camera at the other end of a link; its frames bear the client's time."""

    name: str
    link: ScannerLink
    settings: ScannerCameraSettings

    @property
    def simulated(self) -> bool:
        """Whether it looks at a virtual rig."""
        return self.link.simulated

    @property
    def there(self) -> bool:
        """Whether the scanner has it now: simulated ones come with a scene."""
        return self.name in self.link.facts["cameras"]

    @property
    def facts(self) -> CameraFacts:
        """What does not change about it."""
        known = self.link.facts["cameras"]
        if self.name not in known:
            raise InvalidInput(
                f"the scanner at {self.settings.server} has no {self.name}; it has "
                f"{', '.join(known) or 'no camera'}"
            )
        facts = CameraFacts(**known[self.name])
        if (facts.columns, facts.rows) != (self.settings.columns, self.settings.rows):
            raise InvalidInput(
                f"{self.name} has {facts.columns} x {facts.rows} px at {self.settings.server}, and "
                f"{self.settings.columns} x {self.settings.rows} px in the rig file here: correct one of them"
            )
        return facts

    def describe(self) -> str:
        """Return what it is."""
        return self.settings.described(self.link)

    def arm(self, exposure: float) -> None:
        """Make ready to be triggered."""
        self.link.ask("arm", camera=self.name, exposure=exposure)

    def trigger(self) -> None:
        """Take a frame; other scanners need not wait until it is exposed."""
        self.link.tell("trigger", camera=self.name)

    def read(self, timeout_s: float) -> Frame:
        """Return the oldest frame that was not read; raise `FrameLost` or `LinkLost` when none comes."""
        reply, data = self.link.ask("read", timeout_s + _TRANSFER_S, camera=self.name, timeout_s=timeout_s)
        facts = self.facts
        image = np.frombuffer(data, facts.dtype).reshape(facts.rows, facts.columns)
        time_s, *fired = (float(t) + self.link.behind_s for t in (reply["time_s"], *reply["fired_s"]))
        return Frame(int(reply["number"]), time_s, image, Fired(*fired))

    def disarm(self) -> None:
        """Stop taking frames."""
        self.link.ask("disarm", camera=self.name)


def connect(settings: ScannerCameraSettings, context: DriverContext) -> ScannerCamera:
    """Connect the scanner, once for all of its sensors."""
    return ScannerCamera(settings.name, link_to(settings.server, settings.key_file, context), settings)


DRIVER = CameraDriver("scanner", ScannerCameraSettings, connect)
