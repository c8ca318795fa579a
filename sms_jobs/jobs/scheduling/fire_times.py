"""When a schedule fires: cron expressions, points in time and intervals, in a zone with its summer time.

Written as text: "cron 0 2 * * *", "at 2026-05-04T02:00+01:00", "every 7200" (seconds), "after wing-fatigue".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import islice
from typing import Literal, TypeAlias
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from cronsim import CronSim, CronSimError

from sms_jobs.errors import InvalidInput
from sms_jobs.records.times import LATEST, checked_time

Form: TypeAlias = Literal["cron", "at", "every", "after"]
_LEAST_INTERVAL_S = 1.0
_LONGEST_INTERVAL_S = 3660 * 86400.0


@dataclass(frozen=True)
class Expression:
    """When a schedule fires.

    Attributes
    ----------
    form
        Which of the four forms.
    what
        Five fields of cron; a time with zone; seconds; the name of a campaign.
    zone
        In which cron's clock runs.
    """

    form: Form
    what: str
    zone: ZoneInfo

    def __str__(self) -> str:
        return f"{self.form} {self.what}"

    @property
    def in_words(self) -> str:
        """As people read it: "every 2 h" instead of its seconds, which are kept."""
        return f"every {_interval(float(self.what))}" if self.form == "every" else str(self)


def parse_expression(text: str, zone: str) -> Expression:
    """Read an expression.

    Raises
    ------
    InvalidInput
        It is none of the four forms, or the zone does not exist.
    """
    where = zone_named(zone)
    form, _, what = text.strip().partition(" ")
    what = what.strip()
    if form == "cron":
        try:
            CronSim(what, datetime.now(where))
        except CronSimError as error:
            raise InvalidInput(
                f"'{what}' is no cron expression ({error}); give minute, hour, day, month, weekday, such as "
                "'0 2 * * *' for two o'clock every night"
            ) from None
        return Expression("cron", what, where)
    if form == "at":
        return Expression("at", _moment(what, where).isoformat(), where)
    if form == "every":
        return Expression("every", f"{_seconds(what):.15g}", where)
    if form == "after" and what:
        return Expression("after", what, where)
    raise InvalidInput(f"'{text}' is no schedule; write cron, at, every or after, and what follows it")


def zone_named(name: str) -> ZoneInfo:
    """Return the IANA time zone of that name; raise `InvalidInput` where there is none."""
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise InvalidInput(
            f"there is no time zone '{name}'; give an IANA name such as Europe/London, or UTC"
        ) from None


def _moment(text: str, zone: ZoneInfo) -> datetime:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise InvalidInput(
            f"'{text}' is no time; write it like 2026-05-04T02:00, or with a zone 2026-05-04T02:00+01:00"
        ) from None
    return checked_time(moment if moment.tzinfo is not None else moment.replace(tzinfo=zone), f"'{text}'")


_UNITS_S = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
_IN_WORDS = {"m": "min"}


def _seconds(text: str) -> float:
    number, unit = (text[:-1], text[-1]) if text[-1:] in _UNITS_S else (text, "s")
    try:
        seconds = float(number) * _UNITS_S[unit]
    except ValueError:
        seconds = 0.0
    if not _LEAST_INTERVAL_S <= seconds <= _LONGEST_INTERVAL_S:
        raise InvalidInput(
            f"'{text}' is no interval; write a number with s, m, h or d, of at least {_LEAST_INTERVAL_S:g} s "
            f"and at most {_LONGEST_INTERVAL_S / 86400.0:g} d"
        )
    return seconds


def _interval(seconds: float) -> str:
    """Write an interval to the millisecond, in the largest unit of which it then is a whole number."""
    seconds = round(seconds, 3)
    unit = next((unit for unit in reversed(_UNITS_S) if not seconds % _UNITS_S[unit]), "s")
    return f"{seconds / _UNITS_S[unit]:.15g} {_IN_WORDS.get(unit, unit)}"


def fire_times(expression: Expression, began: datetime, after: datetime) -> Iterator[datetime]:
    """Yield the times in UTC at which a schedule that `began` at a time fires later than `after`.

    One that waits for a campaign has no times of its own. Times that a zone's clock leaves out in spring
    come at the next minute that there is; those that it shows twice in autumn come once.
    """
    if expression.form == "at":
        moment = datetime.fromisoformat(expression.what).astimezone(UTC)
        if moment > after:
            yield moment
    elif expression.form == "every":
        step = timedelta(seconds=float(expression.what))
        moment = began + max((after - began) // step + 1, 1) * step
        while moment < LATEST:
            yield moment.astimezone(UTC)
            moment += step
    elif expression.form == "cron":
        for moment in CronSim(expression.what, after.astimezone(expression.zone)):
            yield moment.astimezone(UTC)


def times_until(
    expression: Expression, began: datetime, after: datetime, until: datetime, most: int
) -> list[datetime]:
    """Return the times later than `after` and not later than `until`; of more than `most` the last ones."""
    found: list[datetime] = []
    for moment in fire_times(expression, began, after):
        if moment > until:
            break
        found.append(moment)
        if len(found) > most:
            del found[0]
    return found


def next_times(expression: Expression, began: datetime, after: datetime, count: int) -> list[datetime]:
    """Return the next few times later than `after`."""
    return list(islice(fire_times(expression, began, after), count))
