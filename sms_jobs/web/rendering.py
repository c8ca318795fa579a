"""Templates, and how times, sizes and numbers are written in them."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from functools import cache, lru_cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from sms_jobs.records.job import SHORT_ID
from sms_jobs.records.plain import plain
from sms_jobs.records.sizes import number_of, size

NOTHING = "–"
_STATES = {
    "succeeded": "good",
    "recorded": "good",
    "measured": "good",
    "computed": "good",
    "running": "busy",
    "queued": "waits",
    "waiting": "waits",
    "planned": "waits",
    "held": "asks",
    "failed": "bad",
    "quarantined": "bad",
    "lost": "bad",
    "needs-operator": "asks",
    "stale": "asks",
    "skipped": "off",
    "cancelled": "off",
}


def rendered(template: str, **given: Any) -> str:
    """Return the page that a template makes of values; everything but `Markup` is escaped."""
    return _environment().get_template(template).render(**given)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("sms_jobs.web.pages"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        "when": when,
        "bytes": lambda count: NOTHING if count is None else size(count),
        "number": number,
        "number_of": number_of,
        "duration": duration,
        "short": lambda job: job[:SHORT_ID],
        "state": state,
        "json": lambda value: json.dumps(plain(value), ensure_ascii=False, indent=1),
    }
    return made


def when(moment: datetime | None) -> Markup:
    """Write a time in UTC; the browser shows it in its own zone."""
    if moment is None:
        return Markup("") + NOTHING
    utc = moment.astimezone(UTC)
    shown = utc.strftime("%Y-%m-%d %H:%M:%S UTC")
    return Markup('<time datetime="{}" title="{}">{}</time>').format(utc.isoformat(), shown, shown)


def number(value: float | int | None, unit: str = "") -> str:
    """Write a number with four digits and its unit; a dash for what is missing or not finite."""
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{_digits(value)} {unit}".rstrip()


def _digits(value: float | int) -> str:
    if isinstance(value, int):
        return f"{value:,}"
    if value and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.4g}"
    after = max(0, 3 - math.floor(math.log10(abs(value)))) if value else 0
    text = f"{value:,.{after}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def duration(seconds: float | None) -> str:
    """Write how long something takes: 45 s, 12 min, 3.5 h."""
    if seconds is None:
        return NOTHING
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


@lru_cache(maxsize=64)
def state(name: str) -> Markup:
    """Write the state of a job: by its word, and by a colour."""
    return Markup('<span class="state {}">{}</span>').format(_STATES.get(name, "off"), name)
