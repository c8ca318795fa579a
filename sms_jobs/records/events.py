"""Events of a test that a stream of frames is kept around: a load that is passed, or that drops."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from sms_jobs.errors import InvalidInput
from sms_jobs.records.units import Typed, duration_s, time_words, typed

Comes: TypeAlias = Literal["above", "below", "drops"]

_SIGNS: Final[dict[str, Comes]] = {">": "above", "<": "below", "drops": "drops"}
_WITHIN_S: Final = 1.0
_LONGEST_DROP_S: Final = 60.0
_EVENT = re.compile(
    r"\s*(?P<channel>[A-Za-z0-9][A-Za-z0-9._-]*)(?:\s*(?P<sign>[<>])|\s+(?P<word>drops)\b(?:\s+by\b)?)"
    r"\s*(?P<quantity>[^\s<>]+(?:\s+(?!in\b)[^\s\d<>]+)?)(?:\s+in\s+(?P<within>[^\s]+(?:\s+[^\s\d]+)?))?\s*"
)


@dataclass(frozen=True)
class Event:
    """What has to come, in the unit of its channel.

    Attributes
    ----------
    channel, unit
        Of the rig, and the unit of its readings.
    comes
        Whether the readings go above a limit, below it, or drop by so much.
    limit
        The limit, or by how much they drop.
    within_s
        A drop is from the highest reading of so many seconds, or from the reading before, if that is older.
    """

    channel: str
    unit: str
    comes: Comes
    limit: float
    within_s: float = _WITHIN_S

    def __str__(self) -> str:
        quantity = f"{self.limit:g} {self.unit}"
        if self.comes == "drops":
            return f"{self.channel} drops by {quantity} in {time_words(self.within_s)}"
        return f"{self.channel} {'>' if self.comes == 'above' else '<'} {quantity}"


@dataclass(frozen=True)
class TypedEvent:
    """An event as somebody has typed it; its quantity has a unit of its own. See `Event`."""

    channel: str
    comes: Comes
    quantity: Typed
    within_s: float = _WITHIN_S

    def in_unit(self, unit: str) -> Event:
        """Return it in the unit of its channel; raise `InvalidInput` for another quantity, or no drop."""
        what = f"what {self.channel} is compared with"
        limit = self.quantity.in_unit(unit, what)
        if self.comes == "drops" and limit <= 0.0:
            raise InvalidInput(
                f"{self.channel} is to drop by '{self.quantity.text}', and every reading does: give more "
                "than 0"
            )
        return Event(self.channel, unit, self.comes, limit, self.within_s)


def typed_event(text: str, what: str) -> TypedEvent:
    """Read an event, as 'load_n > 20kN', 'load_n < 1kN' or 'load_n drops 2kN in 1s'.

    Raises
    ------
    InvalidInput
        It is none, or it names no unit.
    """
    found = _EVENT.fullmatch(text)
    if found is None:
        raise InvalidInput(
            f"{what} is '{text}', which is no event: write one such as 'load_n > 20kN', 'load_n < 1kN' or "
            "'load_n drops 2kN in 1s'"
        )
    comes = _SIGNS[found["sign"] or found["word"]]
    within_s = _WITHIN_S
    if found["within"] is not None:
        if comes != "drops":
            raise InvalidInput(
                f"{what} is '{text}': only a drop is in a time; leave out 'in {found['within']}'"
            )
        within_s = duration_s(found["within"], f"the time of {what}", 0.01, _LONGEST_DROP_S)
    return TypedEvent(found["channel"], comes, typed(found["quantity"], what), within_s)
