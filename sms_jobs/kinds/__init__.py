"""The job kinds, one file each: a module here that has a `KIND` is found by itself."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from typing import Any

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import Kind


@cache
def all_kinds() -> dict[str, Kind[Any]]:
    """Return every job kind by name."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        kind = getattr(importlib.import_module(f"{__name__}.{module.name}"), "KIND", None)
        if kind is not None:
            found[kind.name] = kind
    return found


def kind_named(name: str) -> Kind[Any]:
    """Return the kind of that name; raise `InvalidInput` where there is none."""
    kinds = all_kinds()
    if name not in kinds:
        raise InvalidInput(f"there is no job kind '{name}'; choose one of {', '.join(sorted(kinds))}")
    return kinds[name]
