"""The groups of figures, one file each: a module here that has a `GROUP` is found by itself."""

from __future__ import annotations

from functools import cache

from sms_jobs.bench.figures import Group
from sms_jobs.discovery import chosen, declared


@cache
def all_groups() -> dict[str, Group]:
    """Return every group by name."""
    return declared(__name__, "GROUP")


def group_named(name: str) -> Group:
    """Return the group of that name; raise `InvalidInput` where there is none."""
    return chosen(all_groups(), name, "benchmark")
