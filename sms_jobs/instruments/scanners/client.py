"""The links of a rig to its scanners: one for each, whichever of its sensors asks first."""

from __future__ import annotations

from pathlib import Path

from sms_jobs.instruments.optical_drivers import DriverContext
from sms_jobs.instruments.scanners.keys import read_key
from sms_jobs.instruments.scanners.link import Address, ScannerLink


def links(context: DriverContext) -> dict[tuple[str, str], ScannerLink]:
    """Return the links that a rig has, by address and file of the key; more may come."""
    return context.shared(links, dict)


def link_to(server: str, key_file: str, context: DriverContext) -> ScannerLink:
    """Return the link to a scanner; it ends with the rig's connection.

    Raises
    ------
    ConfigurationError
        There is no key.
    InstrumentError
        The server, or one of its instruments, does not answer.
    """
    known = links(context)
    if (server, key_file) not in known:
        setting = None if context.room is None else context.room.setting
        link = ScannerLink(Address.parse(server), read_key(Path(key_file)), context.clock, setting)
        context.ending.callback(link.close)
        known[server, key_file] = link
    return known[server, key_file]
