"""Fields of a file for whoever draws them: samples, single pixels, sections, gauges."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Header, Path, Query
from fastapi.responses import Response

import sms_jobs
from sms_jobs.app.fields import field_gauges, field_pages, field_values
from sms_jobs.app.fields.field_sources import SAMPLES
from sms_jobs.app.holdings import sealed_files
from sms_jobs.web.identity import Acting
from sms_jobs.web.routes import Routes, answer
from sms_jobs.web.validators import has_already

ROUTES = Routes("drawing")

File = Annotated[int, Path(ge=1, description="Number of the file.")]
Part = Annotated[str | None, Query(description="Which of several groups of records, as C1.")]
Name = Annotated[str, Query(description="Of the quantity, as 'strain xx'.")]
Pixel = Annotated[int, Query(ge=0)]


@ROUTES.offer("GET", "/fields/{file}", field_pages.field_page)
def field_page(services: Acting, file: File, part: Part = None) -> Any:
    """Return what can be shown."""
    return answer(field_pages.field_page(services, str(file), part))


@ROUTES.offer("GET", "/fields/{file}/values", field_values.values)
def values(
    services: Acting,
    file: File,
    name: Name,
    part: Part = None,
    samples: Annotated[int, Query(ge=16, le=field_values.MOST_SAMPLES)] = SAMPLES,
    window: Annotated[
        str | None, Query(pattern=r"^\d{1,6}(,\d{1,6}){3}$", description="As 'top,left,rows,columns'.")
    ] = None,
) -> Any:
    """Return packed samples."""
    top, left, rows, columns = (int(n) for n in window.split(",")) if window else (0, 0, 0, 0)
    asked = (top, left, rows, columns) if window else None
    return answer(field_values.values(services, str(file), name, part=part, samples=samples, window=asked))


@ROUTES.offer("GET", "/fields/{file}/first.png", field_values.first_picture, media=["image/png"])
def first_picture(
    services: Acting,
    file: File,
    part: Part = None,
    name: Annotated[str | None, Query()] = None,
    unless: Annotated[str | None, Header(alias="if-none-match")] = None,
) -> Response:
    """Return a small picture, unless whoever asks has it already."""
    of = sealed_files.sealed_file(services, str(file)).file
    # The same file drawn by the same version is the same picture; a browser keeps it, and asks each time.
    tag = f'"{of.sha256 or of.content_hash}-{sms_jobs.__version__}"'
    headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
    if has_already(unless, tag):
        return Response(status_code=304, headers=headers)
    drawn = field_values.first_picture(services, str(file), part=part, name=name)
    return Response(drawn, headers=headers, media_type="image/png")


@ROUTES.offer("GET", "/fields/{file}/at", field_values.value_at)
def value_at(services: Acting, file: File, name: Name, column: Pixel, row: Pixel, part: Part = None) -> Any:
    """Return a pixel."""
    return answer(field_values.value_at(services, str(file), name, column, row, part=part))


@ROUTES.offer("GET", "/fields/{file}/gauge", field_gauges.gauge_at)
def gauge(
    services: Acting,
    file: File,
    gauge: Annotated[str, Query(description="As 'G1 x=10 y=-20 length=6'.", pattern=r"\S", max_length=200)],
    part: Part = None,
) -> Any:
    """Return what a gauge reads."""
    return answer(field_gauges.gauge_at(services, str(file), gauge, part=part))
