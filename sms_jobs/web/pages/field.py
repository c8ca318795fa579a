"""The fields of a file: maps to point at, sections, gauges, charts over the states, two side by side."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Annotated, Any

from fastapi import Path, Query
from fastapi.responses import HTMLResponse, Response

from sms_jobs.app.fields import exporting, field_pages
from sms_jobs.app.fields.field_pages import FieldPage, SimilarResult
from sms_jobs.web.console import Page, Pages

PAGES = Pages("field")

_UNCHANGED = {"Cache-Control": "no-cache"}


@PAGES.show("/field/{file}", field_pages.field_page)
def field(
    page: Page,
    file: Annotated[int, Path(ge=1)],
    part: Annotated[str | None, Query()] = None,
    other: Annotated[int | None, Query(alias="with", ge=1)] = None,
) -> HTMLResponse:
    """Show the fields of a file."""
    shown = field_pages.field_page(page.services, str(file), part or None)
    beside = None if other is None else field_pages.field_page(page.services, str(other), part or None)
    return page.render(
        "field.html",
        shown=shown,
        beside=beside,
        maps=[_about(one, f"m{place}") for place, one in enumerate((shown, beside)) if one is not None],
        steps=_steps(shown),
        views=[one for one in shown.similar if one.state == shown.state],
        formats=exporting.formats_of(page.services, str(file)),
    )


@PAGES.router.get("/static/field-page.js")
def script() -> Response:
    """Return what draws fields, and the script of the page."""
    return Response(_script(), media_type="text/javascript", headers=_UNCHANGED)


@PAGES.router.get("/static/field-page.css")
def style() -> Response:
    """Return the style of maps and of the page."""
    return Response(_style(), media_type="text/css", headers=_UNCHANGED)


@cache
def _script() -> str:
    return f'"use strict";\n(() => {{\n{field_pages.drawing_script()}\n{_own("field.js")}\n}})();\n'


@cache
def _style() -> str:
    return field_pages.drawing_style() + _own("field.css")


def _own(name: str) -> str:
    return files("sms_jobs.web").joinpath("static", name).read_text(encoding="utf-8")


def _steps(shown: FieldPage) -> tuple[SimilarResult | None, SimilarResult | None]:
    """Return the same view of the state before, and of that after."""
    row = [one for one in shown.similar if one.view == shown.view]
    place = next((k for k, one in enumerate(row) if one.file == shown.file.id), None)
    if place is None:
        return None, None
    return row[place - 1] if place else None, row[place + 1] if place + 1 < len(row) else None


def _about(shown: FieldPage, name: str) -> dict[str, Any]:
    """Return what the script that draws has to know."""
    row = [one for one in shown.similar if one.view == shown.view]
    return {
        "id": name,
        "file": shown.file.id,
        "source": shown.file.source,
        "campaign": shown.campaign,
        "part": shown.part,
        "key": f"{shown.campaign} {shown.camera}",
        "state": shown.state,
        "view": shown.view,
        "title": f"{shown.file.source} {shown.file.subject} {shown.part}".rstrip(),
        "rows": shown.size[0],
        "columns": shown.size[1],
        "step": shown.step_px,
        "fields": [
            {
                "name": one.name,
                "unit": one.unit,
                "flags": one.flags,
                "record": one.record,
                "array": one.array,
                "component": one.component or 0,
                "scale": one.scale,
            }
            for one in shown.quantities
        ],
        "position": shown.position,
        "movement": shown.movement,
        "mmPerPx": None,
        "states": [{"file": one.file, "state": one.state, "load": one.load_n} for one in row],
        "turn": shown.turn,
        "shift": shown.shift,
    }
