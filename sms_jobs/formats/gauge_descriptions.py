"""Gauges as people write them: where a virtual one sits, and what a real one read."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite, radians
from pathlib import Path

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.csv_tables import csv_rows
from sms_jobs.formats.interchange.text_files import read_text
from sms_jobs.metrology.deformation.strain.gauges import GaugePlace

_FORM = "NAME x=MM y=MM length=MM [width=MM] [angle=DEGREES]"
_FORM_PX = "NAME x=100px y=80px length=60px [width=30px] [angle=DEGREES]"
_LENGTHS = ("x", "y", "length", "width")


@dataclass(frozen=True)
class DescribedGauge:
    """A gauge as it was written: its name, its place, and the unit of the place's lengths, mm or px."""

    name: str
    place: GaugePlace
    unit: str


def described_gauge(text: str) -> DescribedGauge:
    """Return what 'G1 x=10 y=-20 length=6 width=3 angle=45' or 'G1 x=100px y=80px length=60px' describes.

    Without a width the grid is half as wide as long; without an angle it lies along the x axis. Raises
    `InvalidInput` for anything else.
    """
    name, *words = text.split()
    given: dict[str, float] = {}
    units: set[str] = set()
    for word in words:
        key, equals, value = word.partition("=")
        if key in _LENGTHS:
            units.add("px" if value.endswith("px") else "mm")
            value = value.removesuffix("px").removesuffix("mm")
        try:
            given[key] = float(value)
        except ValueError:
            equals = ""
        if not equals or key not in (*_LENGTHS, "angle") or not isfinite(given[key]):
            raise InvalidInput(f"'{word}' of gauge '{name}' cannot be understood; write {_FORM}")
    missing = [key for key in ("x", "y", "length") if key not in given]
    if missing or "=" in name:
        raise InvalidInput(f"gauge '{text}' has no {missing[0] if missing else 'name'}; write {_FORM}")
    if len(units) > 1:
        raise InvalidInput(f"gauge '{name}' has lengths in mm and in px; write {_FORM} or {_FORM_PX}")
    width = given.get("width", 0.5 * given["length"])
    if given["length"] <= 0.0 or width <= 0.0:
        raise InvalidInput(f"gauge '{name}' must be longer and wider than 0 mm; write {_FORM}")
    angle = radians(given.get("angle", 0.0))
    return DescribedGauge(
        name, GaugePlace(given["x"], given["y"], given["length"], width, angle), units.pop()
    )


def gauge_from(text: str) -> tuple[str, GaugePlace]:
    """Return the name and place of a gauge on a surface, in mm; raise `InvalidInput` for one in pixels."""
    found = described_gauge(text)
    if found.unit != "mm":
        raise InvalidInput(
            f"gauge '{found.name}' is in pixels, which are for cameras without a projector; on a surface "
            f"write {_FORM}"
        )
    return found.name, found.place


@dataclass(frozen=True)
class GaugeReading:
    """What a real gauge read at a state, as a ratio."""

    state: str
    gauge: str
    strain: float


def read_gauge_file(path: Path) -> tuple[GaugeReading, ...]:
    """Read a CSV file with the columns state, gauge and microstrain, in any order.

    Raises `InvalidInput` with the line for a missing column, a reading that is no number, and a second one of
    a gauge at a state.
    """
    header, rows = csv_rows(read_text(path, "gauge file").splitlines(), str(path), skip_spaces=True)
    required = ("state", "gauge", "microstrain")
    missing = [name for name in required if name not in header]
    if missing:
        raise InvalidInput(
            f"gauge file {path} has no column {missing[0]}; its first line must name {', '.join(required)}"
        )
    found: dict[tuple[str, str], GaugeReading] = {}
    for number, row in enumerate(rows, start=2):
        state, gauge = row["state"], row["gauge"]
        if (state, gauge) in found:
            raise InvalidInput(
                f"line {number} of gauge file {path} is the second of gauge {gauge} at state {state}: "
                "keep one"
            )
        try:
            strain = 1e-6 * float(row["microstrain"] or "")
        except (ValueError, TypeError):
            strain = inf
        if not isfinite(strain):
            raise InvalidInput(
                f"line {number} of gauge file {path} has the reading '{row['microstrain']}', which is not a "
                "number of microstrain"
            )
        found[state, gauge] = GaugeReading(state, gauge, strain)
    return tuple(found.values())
