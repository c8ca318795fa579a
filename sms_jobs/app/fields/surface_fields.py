"""Numbers at places of a surface, from stored results: virtual strain gauges and sections."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import hypot
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from sms_jobs.app.holdings.inputs import inputs_at
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns, family, search
from sms_jobs.errors import InvalidInput, NotFound, did_you_mean
from sms_jobs.kinds.port_names import AT_REST
from sms_jobs.kinds.products import GAUGES, SURFACE
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import Ancestor, FileView
from sms_jobs.records.sizes import number_of
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import place_of_view

if TYPE_CHECKING:
    from sms_jobs.formats.gauge_descriptions import GaugeReading
    from sms_jobs.formats.profiles import GaugeRow, NamedField
    from sms_jobs.metrology.deformation.strain.gauges import Profile

_MICROSTRAIN = 1e6
_MOST_STATES = 100_000
_MOST_PIECES = 100_000

Place: TypeAlias = tuple[float, float]
"""X and Y in mm, or column and row in px of a camera alone."""


@dataclass(frozen=True)
class Gauges:
    """Virtual gauges, state by state, beside real ones; `left_out` says which of these have no place."""

    rows: tuple[GaugeRow, ...]
    left_out: tuple[str, ...] = ()

    @property
    def rms_difference(self) -> tuple[int, float] | None:
        """How many have a real one beside them, and by how much they differ; None where none has."""
        differences = [r.difference for r in self.rows if r.difference is not None]
        return (len(differences), float(np.sqrt(np.mean(np.square(differences))))) if differences else None

    @property
    def unread(self) -> dict[tuple[str, str], tuple[str, ...]]:
        """The states at which a gauge of a view reads nothing, by both."""
        found: dict[tuple[str, str], tuple[str, ...]] = {}
        for row in self.rows:
            if row.virtual is None:
                found[row.gauge, row.view] = (*found.get((row.gauge, row.view), ()), row.state)
        return found

    def drawn(self) -> bytes:
        """Return a chart over the states as PNG."""
        from sms_jobs.formats.profiles import draw_gauges

        return draw_gauges(self.rows)

    def table(self) -> str:
        """Return the rows as CSV, in microstrain."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        strains = [
            "virtual_microstrain",
            "sigma_microstrain",
            "pixels",
            "real_microstrain",
            "sigma_calibration_microstrain",
        ]
        writer.writerow(["state", "view", "gauge", *strains])
        for r in self.rows:
            values = (
                microstrain(r.virtual),
                microstrain(r.sigma),
                r.pixels,
                microstrain(r.real),
                microstrain(r.sigma_calibration),
            )
            writer.writerow([r.state, r.view, r.gauge, *values])
        return text.getvalue()


def microstrain(strain: float | None) -> str | None:
    """Return a strain as people write it."""
    return None if strain is None else f"{_MICROSTRAIN * strain:.1f}"


@use_case(Right.READ)
def gauges(
    services: Services, campaign: str, *, readings: Path | None = None, view: str | None = None
) -> Gauges:
    """Return what the virtual gauges of a campaign read, state by state, beside real ones.

    Parameters
    ----------
    readings
        CSV file of real gauges: columns state, gauge and microstrain; None for the channels of the states
        that have the names of gauges.
    view
        Only of this view.

    Raises
    ------
    NotFound
        There is no such campaign, or it has no virtual gauges.
    InvalidInput
        The file cannot be read, or none of its readings is of a virtual gauge and a state of the campaign.
    """
    # Many of those who load this module compute nothing.
    from sms_jobs.formats.gauge_descriptions import read_gauge_file
    from sms_jobs.formats.profiles import compared

    given = None if readings is None else read_gauge_file(readings)
    virtual = _virtual(services, campaign, view)
    if given is None:
        return Gauges(tuple(compared(virtual, _entered(services, campaign, {row.gauge for row in virtual}))))
    # What another view reads is known, too, and not asked for here.
    known = virtual if view is None else _virtual(services, campaign, None)
    real, left_out = _known(services, campaign, given, dict.fromkeys(row.gauge for row in known))
    if given and not real:
        raise InvalidInput(f"no reading of gauge file {readings} can be compared: {left_out[0]}")
    return Gauges(tuple(compared(virtual, real)), left_out)


def _known(
    services: Services, campaign: str, given: Sequence[GaugeReading], gauges: Collection[str]
) -> tuple[tuple[GaugeReading, ...], tuple[str, ...]]:
    """Return the readings of states and gauges that there are, and what is to be said of the others."""
    with services.catalogue.reading() as session:
        states = [s.label for s in campaigns.definition(campaigns.campaign_row(session, campaign)).states]
    real = tuple(one for one in given if one.state in states and one.gauge in gauges)
    no_state = Counter(one.state for one in given if one.state not in states)
    no_gauge = Counter(one.gauge for one in given if one.gauge not in gauges)
    left_out = [
        f"{number_of(count, 'reading')} at state {name}, which campaign {campaign} does not have; "
        f"{did_you_mean(name, states)}'sms campaign show {campaign}' shows its own"
        for name, count in no_state.items()
    ]
    left_out += [
        f"{number_of(count, 'reading')} of gauge {name}, which is no virtual gauge of campaign {campaign}; "
        f"{did_you_mean(name, gauges)}it has {', '.join(gauges)}"
        for name, count in no_gauge.items()
    ]
    return real, tuple(left_out)


def _virtual(services: Services, campaign: str, view: str | None) -> list[GaugeRow]:
    """Return the newest readings of every state and view, in the order of the test and of the sensors."""
    from sms_jobs.formats.profiles import GaugeRow

    with services.catalogue.reading() as session:
        states = campaigns.definition(campaigns.campaign_row(session, campaign)).states
        files = search.find_files(session, source="gauges", campaign=campaign, view=view, limit=_MOST_STATES)
    newest: dict[Subject, FileView] = {}
    for file in files:
        newest.setdefault(Subject.parse(file.subject), file)
    if not newest:
        of_view = "" if view is None else f" in view {view}"
        raise NotFound(
            f"campaign {campaign} has no virtual gauges{of_view}; 'sms job submit gauges -c {campaign} "
            '--gauge "G1 x=0 y=0 length=20"\' reads one in the middle'
        )
    rows = []
    order = {state.label: place for place, state in enumerate(states)}
    by_sensors = sorted(newest, key=lambda one: place_of_view(one.view or ""))
    for about in sorted(by_sensors, key=lambda one: order.get(one.state or "", len(order))):
        with services.archive.open(newest[about]) as dataset:
            found = GAUGES.read(dataset)
        common = found.sigma_calibration
        for number, (name, strain, sigma, pixels) in enumerate(
            zip(found.names, found.strain, found.sigma, found.pixels, strict=True)
        ):
            known = bool(np.isfinite(strain))
            rows.append(
                GaugeRow(
                    about.state or "",
                    about.view or "",
                    name,
                    float(strain) if known else None,
                    float(sigma) if known else None,
                    int(pixels),
                    sigma_calibration=float(common[number]) if known and common is not None else None,
                )
            )
    return rows


def _entered(services: Services, campaign: str, names: set[str]) -> tuple[GaugeReading, ...]:
    """Return what the states of a campaign say of real gauges of some names."""
    from sms_jobs.formats.gauge_descriptions import GaugeReading

    with services.catalogue.reading() as session:
        states = campaigns.definition(campaigns.campaign_row(session, campaign)).states
    return tuple(
        GaugeReading(state.label, name, value)
        for state in states
        for name, value in state.channels.items()
        if name in names
    )


@dataclass(frozen=True)
class Section:
    """A field along a line.

    Attributes
    ----------
    file
        Its number.
    columns, rows
        A table: distance and place in mm, or in px of a camera alone, the values, and how many pixels.
    units
        That of each column; "1" of a ratio and of the number of pixels.
    profile, field, unit
        What is drawn: the values over the distance, what they are, and the unit of the distance.
    """

    file: int
    columns: tuple[str, ...]
    rows: tuple[tuple[float | int | None, ...], ...]
    units: tuple[str, ...]
    profile: Profile
    field: NamedField
    unit: str

    @property
    def headings(self) -> tuple[str, ...]:
        """How the columns are called in a table for people: the values with their unit, as others have it."""
        values = self.field.columns
        return tuple(
            f"{name} [{unit}]" if name in values else name
            for name, unit in zip(self.columns, self.units, strict=True)
        )

    def drawn(self) -> bytes:
        """Return the field over the distance as PNG."""
        from sms_jobs.formats.profiles import draw_profile

        return draw_profile(self.profile, self.field, self.unit)

    def table(self) -> str:
        """Return the rows as CSV."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.headings, *self.rows])
        return text.getvalue()


@use_case(Right.READ)
def section(
    services: Services,
    file: str,
    ends: tuple[Place, Place],
    *,
    record: str | None = None,
    field: str | None = None,
    step: float = 2.0,
    width: float = 4.0,
) -> Section:
    """Return a field along a line on the surface, seen along the world's Z axis, or in the image.

    Parameters
    ----------
    record, field
        The first record, and its first image, if they are None.
    step, width
        Distance of the points, and width of the strip that is averaged: mm, or px of a camera alone.

    Raises
    ------
    NotFound
        There is no such file or record.
    InvalidInput
        There is no such field, it does not say where its pixels are, or the line is too short, too long, or
        beside the field.
    """
    from sms_jobs.formats.profiles import named_field
    from sms_jobs.metrology.deformation.strain.gauges import profile_along

    start, end = ends
    if start == end:
        raise InvalidInput(f"the section begins and ends at {_point_text(start)}; give two different points")
    pieces = hypot(end[0] - start[0], end[1] - start[1]) / step
    if not pieces <= _MOST_PIECES:
        raise InvalidInput(
            f"the section from {_point_text(start)} to {_point_text(end)} has {pieces:.3g} steps of "
            f"{step:g}, and may have {_MOST_PIECES}: make it shorter, or the `step` larger"
        )
    with services.catalogue.reading() as session:
        view = search.file_view(session, file)
        parents = family.ancestry(session, view).inputs
    with services.archive.open(view) as dataset:
        name = record or dataset.names[0]
        read: Any = dataset.read(name, dataset.record_class(name))
        values = named_field(read, field)
        lies = SURFACE.read_if_there(dataset)
        own = values.position if lies is None else lies.position
    if own is None and not view.in_plane:
        own = _shape_of(services, parents, file)
    flat = own is None or len(own) == 2
    if own is None or flat:
        own = _pixels(values.values.shape[-2:])
    profile = profile_along(own, values.values, *ends, step_mm=step, width_mm=width)
    if not np.any(profile.pixels):
        raise InvalidInput(
            f"no pixel with a value lies along the section from {_point_text(start)} to {_point_text(end)}; "
            f"the field {_extent_text(own, values.values)}: give two points on it"
        )
    # In an image there is no third coordinate.
    places = ("distance_px", "column_px", "row_px") if flat else ("distance_mm", "X_mm", "Y_mm", "Z_mm")
    unit = "px" if flat else "mm"
    rows = tuple(
        (*map(_plain, (d, *place[: len(places) - 1], *each)), int(count))
        for d, place, each, count in zip(
            profile.distance, profile.position, profile.value.T, profile.pixels, strict=True
        )
    )
    columns = (*places, *values.columns, "pixels")
    units = (*[unit] * len(places), *[values.unit] * len(values.columns), "1")
    return Section(view.id, columns, rows, units, profile, values, unit)


def _point_text(place: Place) -> str:
    return f"{place[0]:g},{place[1]:g}"


def _extent_text(own: np.ndarray[Any, Any], values: np.ndarray[Any, Any]) -> str:
    """Say between which points the pixels with values lie."""
    valid = np.isfinite(values.reshape(-1, *values.shape[-2:])).all(axis=0) & np.isfinite(own[:2]).all(axis=0)
    if not valid.any():
        return "has no values"
    x, y = own[0][valid], own[1][valid]
    return f"lies from {_point_text((x.min(), y.min()))} to {_point_text((x.max(), y.max()))}"


def _pixels(shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    """Return column and row of every pixel as if they were positions, (3, rows, columns)."""
    row, column = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    return np.stack([column, row, np.zeros(shape)])


def _shape_of(services: Services, parents: Sequence[Ancestor], file: str) -> np.ndarray[Any, Any]:
    """Return where the pixels of a result are, by the shape that it was made from."""
    shapes = inputs_at(parents, AT_REST)
    if len(shapes) != 1:
        raise InvalidInput(f"file {file} does not say where its pixels are; choose a result of a view")
    with services.archive.open(shapes[0]) as dataset:
        return SURFACE.read(dataset).position


def _plain(value: float) -> float | None:
    return float(f"{value:.7g}") if np.isfinite(value) else None
