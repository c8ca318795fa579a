"""The groups of figures, one file each: a module here that has a `GROUP` is found by itself."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from sms_jobs.bench.figures import Group
from sms_jobs.errors import InvalidInput


@cache
def all_groups() -> dict[str, Group]:
    """Return every group by name."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        group = getattr(importlib.import_module(f"{__name__}.{module.name}"), "GROUP", None)
        if group is not None:
            found[group.name] = group
    return found


def group_named(name: str) -> Group:
    """Return the group of that name; raise `InvalidInput` where there is none."""
    groups = all_groups()
    if name not in groups:
        raise InvalidInput(f"there is no benchmark '{name}'; choose among {', '.join(sorted(groups))}")
    return groups[name]
