"""Writers of meshes for other programs: a module here that has an `EXPORTER` is found by itself."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.exporters.exporter import Exporter


@cache
def all_exporters() -> dict[str, Exporter]:
    """Return every exporter by name, in order of name."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        exporter = getattr(importlib.import_module(f"{__name__}.{module.name}"), "EXPORTER", None)
        if exporter is not None:
            found[exporter.name] = exporter
    return dict(sorted(found.items()))


def exporter_named(name: str) -> Exporter:
    """Return the exporter of that name; raise `InvalidInput` where there is none."""
    if name not in all_exporters():
        raise InvalidInput(f"there is no export format '{name}'; choose one of {', '.join(all_exporters())}")
    return all_exporters()[name]


__all__ = ["Exporter", "all_exporters", "exporter_named"]
