"""The look that reports and the console share: colours, tables, charts."""

from __future__ import annotations

from functools import cache
from importlib.resources import files


@cache
def look() -> str:
    """Return the style sheet: light and dark colours by name, text, tables, doubts, charts."""
    return files("sms_jobs.formats").joinpath("look.css").read_text(encoding="utf-8")
