"""The job kinds, one file each, in rooms by subject: a module that has a `KIND` is found by itself."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from sms_jobs.discovery import chosen, declared
from sms_jobs.kinds.kind import Kind


@cache
def all_kinds() -> dict[str, Kind[Any]]:
    """Return every job kind by name."""
    return declared(__name__, "KIND")


def kind_named(name: str) -> Kind[Any]:
    """Return the kind of that name; raise `InvalidInput` where there is none."""
    return chosen(all_kinds(), name, "job kind")


def defaults_of_kinds() -> dict[str, Mapping[str, Any]]:
    """Return the defaults of every kind whose results can be computed again, as JSON."""
    found: dict[str, Mapping[str, Any]] = {}
    for name, kind in all_kinds().items():
        if kind.with_instruments:
            continue
        required = any(f.is_required() for f in kind.parameters.model_fields.values())
        found[name] = {} if required else kind.parameters().model_dump(mode="json")
    return found
