"""The job kinds, one file each: a module here that has a `KIND` is found by itself."""

from __future__ import annotations

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
