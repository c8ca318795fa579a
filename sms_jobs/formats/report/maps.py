"""Views on a page: still pictures for print, and the fields themselves for the script that draws maps."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from sms_jobs.formats.figures import Map, draw_map, robust_limits
from sms_jobs.formats.report.html import Markup, figure, figures
from sms_jobs.formats.report.packing import pack, pack_sigma
from sms_jobs.formats.report.page import json_block
from sms_jobs.formats.report.view import VALID, Field, Values, View

_CATEGORIES = 64


@dataclass
class Held:
    """Positions that a page has already, by the key and the name of a field.

    A point of the surface is shown where it was at rest, so that all states have the same positions but for
    where they have no value: a page needs them once.
    """

    _of: dict[tuple[str, str], tuple[Values, dict[str, Any]]] = dataclasses.field(default_factory=dict)

    def description(self, view: View, place: int) -> dict[str, Any] | None:
        """Return that of the same values that the page has, or None."""
        field, first = view.fields[place], view.fields[0]
        if (view.key, field.name) not in self._of or field is first or field.sigma is not None:
            return None
        values, description = self._of[view.key, field.name]
        known, there = np.isfinite(field.values), np.isfinite(values)
        if values.shape != known.shape or not np.array_equal(values[known], field.values[known]):
            return None
        alone = {name: part for name, part in description.items() if name not in ("sigma", "within")}
        if np.array_equal(known, there):
            return alone
        if np.array_equal(known, there & np.isfinite(first.values)):
            return alone | {"within": first.name}
        return None

    def keep(self, view: View, place: int, description: dict[str, Any]) -> None:
        """Remember a position that the page has got, the last of its key and name."""
        field = view.fields[place]
        if field.name in (view.position or ()):
            self._of[view.key, field.name] = (field.values, description)


def view_markup(
    view: View, number: int, state: str, still_px: int, held: Held, level: int = 4
) -> Iterator[Markup]:
    """Yield a view of a state in pieces; `number` tells it from the others of the page.

    `held` is what the page has already, and is added to. `level` is that of its heading, one below the
    heading that it stands under.
    """
    name = f"v{number}"
    yield Markup(
        f'<section class="view" id="{name}" aria-labelledby="{name}t">\n'
        f'<h{level} id="{name}t">{escape(view.title)}</h{level}>'
    )
    yield Markup(f'<div class="stills">{figures(_stills(view, state, still_px)).html}</div>')
    for note in view.notes:
        yield Markup(f'<p class="notes">{escape(note)}</p>')
    about = []
    for place, field in enumerate(view.fields):
        description = held.description(view, place)
        if description is None:
            description = packed_field(field)
            yield from _blocks(description, f"{name}-{place}")
            held.keep(view, place, description)
        about.append(description)
    yield json_block(
        {
            "key": view.key,
            "state": state,
            "title": view.title,
            "rows": view.size[0],
            "columns": view.size[1],
            "step": view.step_px,
            "pitchMm": view.pitch_mm,
            "fields": about,
            "position": view.position,
            "movement": view.movement,
            "mmPerPx": view.mm_per_px,
        },
        "about",
    )
    yield Markup("</section>")


def _stills(view: View, state: str, still_px: int) -> Iterator[Markup]:
    for field in view.fields:
        for values, name in (
            (field.still, field.name),
            (field.still_sigma, f"standard deviation of {field.name}"),
        ):
            if values is not None:
                title = name[:1].upper() + name[1:]
                outlines = field.outlines if values is field.still else None
                image = Map(values, view.size, title, field.unit or "1", outlines)
                yield figure(_lean(draw_map(image, still_px)), f"{state}, {view.key}: {name}")


def _lean(png: bytes) -> bytes:
    """Return a picture of at most 256 colours, which takes a third of the room."""
    from PIL import Image

    out = io.BytesIO()
    with Image.open(io.BytesIO(png)) as picture:
        few = picture.convert("RGB").quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        few.save(out, format="PNG", optimize=True)
    return out.getvalue()


def packed_field(field: Field) -> dict[str, Any]:
    """Return what the script has to know of a field, with its values as text, and its standard deviations."""
    if field.categories is not None:
        return _packed_categories(field)
    packed = pack(field.values, field.sigma, field.grain)
    description: dict[str, Any] = {
        "name": field.name,
        "unit": field.unit,
        "low": packed.low,
        "step": packed.step,
        "text": packed.text,
        "limits": robust_limits(field.values),
    }
    if field.sigma is not None:
        spread = pack_sigma(field.sigma)
        limits = robust_limits(field.sigma)
        description["sigma"] = {"low": spread.low, "step": spread.step, "text": spread.text, "limits": limits}
    return description


def _packed_categories(field: Field) -> dict[str, Any]:
    """Return flags as numbers of a list of meanings, the most frequent first."""
    found, counts = np.unique(field.values[np.isfinite(field.values)].astype(np.int64), return_counts=True)
    order = np.argsort(-counts, kind="stable")
    words = field.categories or {}
    listed = [int(found[place]) for place in order[:_CATEGORIES]]
    numbers = np.full(field.values.shape, np.nan, np.float32)
    for place, flags in enumerate(listed):
        numbers[field.values == flags] = place
    packed = pack(numbers)
    meanings = [words.get(flags, str(flags)) for flags in listed]
    # Coloured by the first of several reasons, as there are too many combinations to tell apart.
    firsts = list(dict.fromkeys([VALID, *map(_first, meanings)]))
    return {
        "name": field.name,
        "unit": field.unit,
        "low": packed.low,
        "step": packed.step,
        "text": packed.text,
        "limits": (0.0, float(max(1, len(listed) - 1))),
        "categories": meanings,
        "names": firsts,
        "groups": [firsts.index(_first(words)) for words in meanings],
    }


def _first(words: str) -> str:
    return words.partition(",")[0]


def _blocks(description: dict[str, Any], name: str) -> Iterator[Markup]:
    """Yield the texts of a packed field as blocks of the page, which its description then names."""
    for part, suffix in ((description, ""), (description.get("sigma"), "s")):
        if part is not None:
            part["data"] = f"{name}{suffix}"
            yield Markup(f'<script type="text/plain" id="{part["data"]}">{part.pop("text")}</script>')
