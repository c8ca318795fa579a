"""The arrays of a record under names that carry their unit, for files of numbers: NPZ and MATLAB."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.exporters.exporter import placed
from sms_jobs.records.fields import Mesh
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.quantity import quantities_of
from sms_jobs.records.quick_look import QuickLook
from sms_jobs.records.system_test import SystemTest

_TEXTS: dict[type, dict[str, str]] = {
    GaugeReadings: {"gauge": "names"},
    QuickLook: {"gauge": "names"},
    SystemTest: {"quantity": "quantities", "state": "states", "view": "views", "missing": "missing"},
}
"""What tells the rows of a record apart: the name of a column, and the field with its texts."""
_LONGEST = 63  # of a name in MATLAB


@dataclass(frozen=True)
class NamedArray:
    """An array, the name under which it is stored, its unit and what it is."""

    name: str
    unit: str
    meaning: str
    values: NDArray[Any]


def texts_of(record: Any) -> dict[str, NDArray[np.str_]]:
    """Return the texts that a record has for each of its rows, by what they are; none for most records."""
    named = _TEXTS.get(type(record), {})
    return {called: np.array(getattr(record, field), np.str_) for called, field in named.items()}


def _identifier(name: str, unit: str, taken: set[str]) -> str:
    """Return a name that any language takes: `displacement_Z_mm`, `covariance_mm2`; ratios have no unit."""
    suffix = "" if unit in ("1", "bit") else "_" + re.sub(r"\W", "", unit.replace("/", "_per_"))
    base = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "value"
    if not base[0].isalpha():
        base = f"v_{base}"
    found = (base[: _LONGEST - len(suffix) - 2] + suffix).lstrip("_")
    while found in taken:
        found += "_"
    taken.add(found)
    return found


def arrays_of(record: Any) -> Iterator[NamedArray]:
    """Yield the arrays of a record; the values of a mesh one by one, each with its own unit.

    Raises `InvalidInput` when it has none, or when they are frames, which are too many to be held at once.
    """
    taken: set[str] = set()
    if isinstance(record, Mesh):
        mesh = placed(record)
        unit = mesh.unit
        yield NamedArray(_identifier("vertices", unit, taken), unit, "position", mesh.vertices)
        meaning = "vertex indices, counter-clockwise seen from outside"
        yield NamedArray(_identifier("faces", "1", taken), "1", meaning, mesh.faces)
        for name, of_value, values in zip(mesh.value_names, mesh.value_units, mesh.values, strict=True):
            yield NamedArray(_identifier(name, of_value, taken), of_value, name, values)
        return
    found = False
    for called, texts in texts_of(record).items():
        yield NamedArray(_identifier(called, "1", taken), "1", f"{called} of each row", texts)
    for name, quantity in quantities_of(record).items():
        values = getattr(record, name)
        if isinstance(values, np.ndarray):
            found = True
            yield NamedArray(_identifier(name, quantity.unit, taken), quantity.unit, quantity.meaning, values)
    if not found:
        raise InvalidInput(f"a {type(record).__name__} has no array to export")
