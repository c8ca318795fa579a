"""Gauges and sections as tables and pictures (thesis Fig. 81)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.figures import as_png, new_figure
from sms_jobs.formats.gauge_descriptions import GaugeReading
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.strain.gauges import Profile
from sms_jobs.records.quantity import quantities_of


@dataclass(frozen=True)
class GaugeRow:
    """A virtual gauge at a state beside the real one; strains are ratios, None where there is none."""

    state: str
    view: str
    gauge: str
    virtual: float | None
    sigma: float | None
    pixels: int
    real: float | None = None
    difference: float | None = None
    sigma_calibration: float | None = None


def compared(virtual: Iterable[GaugeRow], real: Sequence[GaugeReading]) -> list[GaugeRow]:
    """Put the readings of real gauges beside those of virtual ones of the same name and state.

    Raises `InvalidInput` when no reading has a counterpart.
    """
    read = {(one.state, one.gauge): one.strain for one in real}
    rows = []
    for row in virtual:
        strain = read.get((row.state, row.gauge))
        difference = None if strain is None or row.virtual is None else row.virtual - strain
        rows.append(replace(row, real=strain, difference=difference))
    if real and not any(row.real is not None for row in rows):
        known = ", ".join(dict.fromkeys(row.gauge for row in rows))
        raise InvalidInput(
            f"no reading of the gauge file is of a virtual gauge and state; the virtual gauges are {known}"
        )
    return rows


def draw_gauges(rows: Sequence[GaugeRow]) -> bytes:
    """Draw virtual gauges over states with their standard deviations, and real ones as crosses, as PNG."""
    figure = new_figure(7.0, 4.2)
    axes = figure.add_subplot()
    states = list(dict.fromkeys(row.state for row in rows))
    for number, (gauge, view) in enumerate(dict.fromkeys((row.gauge, row.view) for row in rows)):
        own = [r for r in rows if (r.gauge, r.view) == (gauge, view) and r.virtual is not None]
        place = [states.index(r.state) for r in own]
        colour = f"C{number % 10}"
        axes.errorbar(
            place,
            [1e6 * (r.virtual or 0.0) for r in own],
            [1e6 * (r.sigma or 0.0) for r in own],
            fmt="o-",
            color=colour,
            capsize=3,
            label=f"{gauge} ({view})",
        )
        real = [(states.index(r.state), 1e6 * r.real) for r in own if r.real is not None]
        if real:
            axes.plot(*zip(*real, strict=True), "x", color=colour, markersize=9)
    axes.set_xticks(range(len(states)), states)
    axes.set_xlabel("state")
    axes.set_ylabel("strain [microstrain]")
    axes.set_title("virtual gauges (circles) and real ones (crosses)", fontsize="medium")
    axes.legend(fontsize="small")
    return as_png(figure)


@dataclass(frozen=True)
class NamedField:
    """An image field of a record: (components, rows, columns), names, unit, and positions if it has any."""

    values: Floats
    columns: tuple[str, ...]
    unit: str
    position: Floats | None


def named_field(record: Any, name: str | None) -> NamedField:
    """Return an image field of a record by name, or its first.

    Raises `InvalidInput` where there is none of that name.
    """
    images = {key: q for key, q in quantities_of(record).items() if q.is_image and len(q.axes) <= 3}
    if not images:
        raise InvalidInput(f"a {type(record).__name__} has no field over an image")
    chosen = name or next(iter(images))
    if chosen not in images:
        raise InvalidInput(f"there is no image field '{chosen}'; choose among {', '.join(images)}")
    quantity = images[chosen]
    values = np.asarray(getattr(record, chosen), dtype=np.float64)
    values = values if values.ndim == 3 else values[None]
    names = quantity.components or tuple(str(k) for k in range(len(values)))
    columns = tuple(f"{chosen}_{part}" for part in names) if len(values) > 1 else (chosen,)
    return NamedField(values, columns, quantity.unit, getattr(record, "position", None))


def draw_profile(profile: Profile, field: NamedField, length_unit: str = "mm") -> bytes:
    """Draw a field along a section, with the scatter over the strip, as PNG."""
    figure = new_figure(7.0, 4.2)
    axes = figure.add_subplot()
    for name, value, scatter in zip(field.columns, profile.value, profile.scatter, strict=True):
        axes.plot(profile.distance, value, label=name)
        axes.fill_between(profile.distance, value - scatter, value + scatter, alpha=0.25)
    axes.set_xlabel(f"distance [{length_unit}]")
    axes.set_ylabel("" if field.unit == "1" else f"[{field.unit}]")
    axes.legend(fontsize="small")
    return as_png(figure)
