"""Gauges as people write them: where a virtual one sits, and what a real one read."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from math import isfinite, radians
from pathlib import Path

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.deformation.gauges import GaugePlace

_FORM = "NAME x=MM y=MM length=MM [width=MM] [angle=DEGREES]"


def gauge_from(text: str) -> tuple[str, GaugePlace]:
    """Return the name and place that 'G1 x=10 y=-20 length=6 width=3 angle=45' describes.

    Without a width the grid is half as wide as long; without an angle it lies along the specimen's x axis.
    """
    name, *words = text.split()
    given: dict[str, float] = {}
    for word in words:
        key, equals, value = word.partition("=")
        try:
            given[key] = float(value)
        except ValueError:
            equals = ""
        if not equals or key not in ("x", "y", "length", "width", "angle") or not isfinite(given[key]):
            raise InvalidInput(f"'{word}' of gauge '{name}' cannot be understood; write {_FORM}")
    missing = [key for key in ("x", "y", "length") if key not in given]
    if missing or "=" in name:
        raise InvalidInput(f"gauge '{text}' has no {missing[0] if missing else 'name'}; write {_FORM}")
    width = given.get("width", 0.5 * given["length"])
    if given["length"] <= 0.0 or width <= 0.0:
        raise InvalidInput(f"gauge '{name}' must be longer and wider than 0 mm; write {_FORM}")
    return name, GaugePlace(given["x"], given["y"], given["length"], width, radians(given.get("angle", 0.0)))


@dataclass(frozen=True)
class GaugeReading:
    """What a real gauge read at a state, as a ratio."""

    state: str
    gauge: str
    strain: float


def read_gauge_file(path: Path) -> tuple[GaugeReading, ...]:
    """Read a CSV file with the columns state, gauge and microstrain, in any order.

    Raises `InvalidInput` with the line for a missing column or a reading that is no number.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput(f"gauge file {path} cannot be read: {error}") from error
    rows = csv.DictReader(lines, skipinitialspace=True)
    wanted = ("state", "gauge", "microstrain")
    missing = [name for name in wanted if name not in (rows.fieldnames or ())]
    if missing:
        raise InvalidInput(
            f"gauge file {path} has no column {missing[0]}; its first line must name {', '.join(wanted)}"
        )
    found = []
    for number, row in enumerate(rows, start=2):
        try:
            found.append(GaugeReading(row["state"], row["gauge"], 1e-6 * float(row["microstrain"] or "")))
        except (ValueError, TypeError) as error:
            raise InvalidInput(
                f"line {number} of gauge file {path} has the reading '{row['microstrain']}', which is not a "
                "number of microstrain"
            ) from error
    return tuple(found)
