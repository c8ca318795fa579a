"""Writers of meshes for other programs: a module here that has an `EXPORTER` is found by itself."""

from __future__ import annotations

from functools import cache

from sms_jobs.discovery import chosen, declared
from sms_jobs.formats.exporters.exporter import Exporter


@cache
def all_exporters() -> dict[str, Exporter]:
    """Return every exporter by name."""
    return declared(__name__, "EXPORTER")


def exporter_named(name: str) -> Exporter:
    """Return the exporter of that name; raise `InvalidInput` where there is none."""
    return chosen(all_exporters(), name, "export format")


__all__ = ["Exporter", "all_exporters", "exporter_named"]
