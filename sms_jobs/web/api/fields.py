"""Numbers at places of a surface, and displacements compared: as JSON, tables and pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from fastapi import Query
from fastapi.responses import Response

from sms_jobs.app.fields import field_comparison, state_comparison, surface_fields
from sms_jobs.app.fields.field_comparison import ComparisonOptions
from sms_jobs.errors import InvalidInput
from sms_jobs.web.api.files import DRAWING, PNG
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Name, Number, Text
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("fields")

CSV = "text/csv; charset=utf-8"
_MEDIA = ("application/json", "text/csv", PNG)

Form = Annotated[Literal["json", "csv", "png"], Query(alias="format")]
Millimetres = Annotated[float, Query(ge=0, le=1e6, allow_inf_nan=False)]
Coordinate = Annotated[float, Query(ge=-1e9, le=1e9, allow_inf_nan=False)]
Length = Annotated[float, Query(ge=1e-3, le=1e6, allow_inf_nan=False)]


@ROUTES.offer("GET", "/data/{key:int}/section", surface_fields.section, media=_MEDIA)
def section(
    services: Acting,
    key: Number,
    x0: Coordinate,
    y0: Coordinate,
    x1: Coordinate,
    y1: Coordinate,
    record: Text | None = None,
    field: Text | None = None,
    step: Length = 2.0,
    width: Length = 4.0,
    form: Form = "json",
) -> Any:
    """Return a field along a line; in JSON with its scatter over the strip."""
    found = surface_fields.section(
        services, str(key), ((x0, y0), (x1, y1)), record=record, field=field, step=step, width=width
    )
    facts = {
        "file": found.file,
        "columns": found.columns,
        "units": found.units,
        "rows": found.rows,
        "unit": found.unit,
        "scatter": found.profile.scatter.tolist(),
    }
    return _formed(form, lambda: facts, found.table, found.drawn)


@ROUTES.offer("GET", "/campaigns/{name}/gauges", surface_fields.gauges, media=_MEDIA)
def gauges(services: Acting, name: Name, view: Text | None = None, form: Form = "json") -> Any:
    """Return what the virtual gauges of a campaign read, beside real ones."""
    found = surface_fields.gauges(services, name, view=view)
    return _formed(form, lambda: {"campaign": name, "gauges": found.rows}, found.table, found.drawn)


@ROUTES.offer("GET", "/data/{key:int}/compare", field_comparison.difference_of, media=_MEDIA)
def compare(
    services: Acting,
    key: Number,
    other: Annotated[int, Query(alias="with", ge=1, le=2**31 - 1, description="Number of another result.")],
    align: bool = False,
    free_of_motion: bool = False,
    within_mm: Millimetres = 5.0,
    form: Form = "json",
) -> Any:
    """Subtract the displacement of another merged result."""
    how = ComparisonOptions(None, 1.0, align, free_of_motion, within_mm)
    found = field_comparison.difference_of(services, str(key), str(other), how)
    facts = {"file": key, "other": other}
    return _formed(
        form, lambda: facts | found.facts(), found.table, lambda: found.drawn(f"file {key} minus {other}")
    )


@ROUTES.offer("GET", "/campaigns/{name}/compare", state_comparison.compare_states, media=_MEDIA)
def compare_states(
    services: Acting,
    name: Name,
    other: Annotated[Text, Query(alias="with", description="Name of another campaign.")],
    kind: Literal["merge", "combine"] = "merge",
    align: bool = False,
    free_of_motion: bool = False,
    within_mm: Millimetres = 5.0,
    form: Form = "json",
) -> Any:
    """Subtract the displacement of another campaign at every state."""
    if "{" in other:
        # What the command line takes there are files of the machine on which it runs.
        raise InvalidInput("'with' takes the name of a campaign; files are compared on the command line")
    how = ComparisonOptions(None, 1.0, align, free_of_motion, within_mm)
    found = state_comparison.compare_states(services, name, other, kind, how)
    states = [one.named() for one in found.states]
    return _formed(
        form, lambda: {"states": states}, found.table, lambda: found.drawn(f"{name} minus {other}")
    )


def _formed(
    form: str,
    facts: Callable[[], dict[str, Any]],
    table: Callable[[], str | bytes],
    drawn: Callable[[], bytes],
) -> Response:
    """Return what was found in the form that was asked for."""
    if form == "csv":
        return Response(table(), media_type=CSV)
    if form == "png":
        with DRAWING:
            return Response(drawn(), media_type=PNG)
    return answer(facts())
