"""The studies, one file each: a module here that has a `STUDY` is found by itself."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from sms_jobs.bench.study import Study
from sms_jobs.errors import InvalidInput


@cache
def all_studies() -> dict[str, Study]:
    """Return every study by name."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        study = getattr(importlib.import_module(f"{__name__}.{module.name}"), "STUDY", None)
        if study is not None:
            found[study.name] = study
    return found


def study_named(name: str) -> Study:
    """Return the study of that name; raise `InvalidInput` where there is none."""
    studies = all_studies()
    if name not in studies:
        raise InvalidInput(f"there is no study '{name}'; choose one of {', '.join(sorted(studies))}")
    return studies[name]
