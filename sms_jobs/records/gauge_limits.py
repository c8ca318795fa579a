"""Limits on what a quick look says of a gauge, beyond which a plan of recordings stops."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

from sms_jobs.errors import InvalidInput
from sms_jobs.records.statistic_names import GAUGE_QUANTITIES, of_gauge
from sms_jobs.records.units import typed

_UNIT: Final = "mm"
_LIMIT = re.compile(r"\s*(?P<gauge>[^\s<>=]+)\.(?P<quantity>[a-z_]+)\s*(?P<sign>[<>])\s*(?P<limit>[^<>=]+)")


@dataclass(frozen=True)
class GaugeLimit:
    """Beyond which value of a gauge a plan stops.

    Attributes
    ----------
    gauge, quantity
        Its name, and one of `GAUGE_QUANTITIES`.
    above
        Whether it stops above the limit, or below it.
    limit
        In mm.
    """

    gauge: str
    quantity: str
    above: bool
    limit: float

    def __str__(self) -> str:
        return f"{self.gauge}.{self.quantity} {'>' if self.above else '<'} {self.limit:g} {_UNIT}"

    @property
    def statistic(self) -> str:
        """By which name the quick look has the value."""
        return of_gauge(self.gauge, self.quantity)

    def is_reached(self, value: float) -> bool:
        """Say whether a value is beyond the limit."""
        return value > self.limit if self.above else value < self.limit

    def as_json(self) -> dict[str, Any]:
        """Return it as the catalogue keeps it."""
        return asdict(self)

    @classmethod
    def from_json(cls, kept: Mapping[str, Any]) -> GaugeLimit:
        """Read it back."""
        return cls(**kept)


def gauge_limit(text: str, what: str) -> GaugeLimit:
    """Read a limit, as 'g1.extension_mm > 0.5mm'; raise `InvalidInput` where it is none, or has no unit."""
    found = _LIMIT.fullmatch(text)
    if found is None or found["quantity"] not in GAUGE_QUANTITIES:
        first, *others = GAUGE_QUANTITIES
        raise InvalidInput(
            f"{what} is '{text}', which is no limit of a gauge: write GAUGE.{first} > 0.5mm, or with "
            f"{', '.join(others)} in its place"
        )
    limit = typed(found["limit"], what).in_unit(_UNIT, what)
    return GaugeLimit(found["gauge"], found["quantity"], found["sign"] == ">", limit)


@dataclass(frozen=True)
class Look:
    """Whether there is a quick look at a state once it is recorded, and which limits hold the plan."""

    enabled: bool
    stop_if: tuple[GaugeLimit, ...] = ()


NO_LOOK: Final = Look(False)
