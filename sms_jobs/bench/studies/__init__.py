"""The studies, one file each: a module here that has a `STUDY` is found by itself."""

from __future__ import annotations

from functools import cache

from sms_jobs.bench.study import Study
from sms_jobs.discovery import chosen, declared


@cache
def all_studies() -> dict[str, Study]:
    """Return every study by name."""
    return declared(__name__, "STUDY")


def study_named(name: str) -> Study:
    """Return the study of that name; raise `InvalidInput` where there is none."""
    return chosen(all_studies(), name, "study")
