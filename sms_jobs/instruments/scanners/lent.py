"""What a camera and a projector of a scanner that has a computer of its own have in common."""

from __future__ import annotations

from dataclasses import dataclass

from sms_jobs.instruments.scanners.link import Address, ScannerLink
from sms_jobs.records.optical_instruments import OpticalInstrument


@dataclass(frozen=True)
class LentInstrument(OpticalInstrument):
    """A camera or projector that `sms rig serve` lends.

    Attributes
    ----------
    server
        Its address, host:port.
    key_file
        A copy of the server's key.
    """

    server: str
    key_file: str

    def __post_init__(self) -> None:
        super().__post_init__()
        Address.parse(self.server)

    def described(self, link: ScannerLink) -> str:
        """Return what it is, as its server says."""
        description = link.facts["described"].get(self.name, "nothing is known of it")
        return f"scanner at {self.server}: {description}"
