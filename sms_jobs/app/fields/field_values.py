"""Values of fields for a page that draws them: samples, a first picture, single pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sms_jobs.app.fields.field_sources import SAMPLES, Placed, Window, fields_of, read, sampled, step_of
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from sms_jobs.formats.drawing.quantities import Reading

MOST_SAMPLES = 4096
_GLANCE = 256


@dataclass(frozen=True)
class PixelValue:
    """A quantity at a pixel, as it is archived.

    Attributes
    ----------
    column, row
        Of the pixel.
    value, sigma
        In `unit`; None where there is none.
    reason
        Why there is no value, in words; empty where there is one.
    position
        In mm; None where it is not known.
    """

    file: int
    name: str
    unit: str
    column: int
    row: int
    value: float | None
    sigma: float | None
    reason: str
    position: tuple[float, ...] | None


@use_case(Right.READ)
def values(
    services: Services,
    key: str,
    name: str,
    *,
    part: str | None = None,
    samples: int = SAMPLES,
    window: Window | None = None,
) -> dict[str, Any]:
    """Return samples of a quantity, packed as in a report, with how to unpack and colour them.

    Parameters
    ----------
    name
        Of the quantity.
    samples
        Most along the longer side.
    window
        First row and column, and how many of each; the whole image if it is None.

    Raises
    ------
    NotFound
        There is no such file, part or quantity.
    InvalidInput
        The window is not inside the image.
    ArchiveCorrupt
        It is not what was sealed.
    """
    from sms_jobs.formats.report.maps import packed_field
    from sms_jobs.formats.report.view import Sampler

    one = fields_of(services, key, part).named(name)
    top, left, rows, columns = window or (0, 0, *one.size)
    if (
        min(top, left) < 0
        or min(rows, columns) < 1
        or top + rows > one.size[0]
        or left + columns > one.size[1]
    ):
        raise InvalidInput(
            f"the window of {columns} x {rows} px from {left}, {top} is not inside the image of "
            f"{one.size[1]} x {one.size[0]} px; choose one that is"
        )
    step = step_of((rows, columns), samples)
    readings = [r for r in (one.shown.values, one.shown.sigma) if r is not None]
    known, *sigma = sampled(services.archive, one, readings, step, window=window)
    # Sampled already.
    sampler = Sampler((known.shape[0], known.shape[1]), max(known.shape), 0)
    if one.shown.flags:
        made = sampler.reasons(one.shown.name, known)
    else:
        made = sampler.field(one.shown.name, one.shown.unit, known, *sigma)
    return packed_field(made) | {"every": step}


@use_case(Right.READ)
def first_picture(services: Services, key: str, *, part: str | None = None, name: str | None = None) -> bytes:
    """Return a small map of a quantity at once, as PNG, before it is compared with what was sealed.

    Parameters
    ----------
    name
        Of the quantity; the first if it is None.

    Raises
    ------
    NotFound
        There is no such file, part or quantity.
    """
    from sms_jobs.formats.figures import colours_as_png

    fields = fields_of(services, key, part)
    one = fields.placed[0] if name is None else fields.named(name)
    (known,) = sampled(services.archive, one, [one.shown.values], step_of(one.size, _GLANCE))
    return colours_as_png(known.astype(np.float32), one.shown.unit)


@use_case(Right.READ)
def value_at(
    services: Services, key: str, name: str, column: int, row: int, *, part: str | None = None
) -> PixelValue:
    """Return a quantity at a pixel as it is archived, with why there is none.

    Raises
    ------
    NotFound
        There is no such file, part or quantity.
    InvalidInput
        The pixel is outside the image.
    ArchiveCorrupt
        It is not what was sealed.
    """
    from sms_jobs.formats.report.view import in_words

    fields = fields_of(services, key, part)
    one = fields.named(name)
    if not (0 <= row < one.size[0] and 0 <= column < one.size[1]):
        raise InvalidInput(
            f"pixel {column}, {row} is outside the image of {one.size[1]} x {one.size[0]} px; choose one "
            "inside"
        )

    def at(asked: Placed, *readings: Reading | None) -> list[float]:
        pixel = (slice(row, row + 1, 1), slice(column, column + 1, 1))
        found = read(services.archive, asked, [each for each in readings if each is not None], *pixel)
        return [float(each[0, 0]) for each in found]

    value, *sigma = at(one, one.shown.values, one.shown.sigma)
    status = [p for p in fields.placed if p.shown.flags and p.shown.record == one.shown.record]
    bits = int(at(status[0], status[0].shown.values)[0]) if status else 0
    axes = [fields.named(axis) for axis in fields.position or ()]
    place = tuple(at(axis, axis.shown.values)[0] for axis in axes)
    return PixelValue(
        fields.file.id,
        name,
        one.shown.unit,
        column,
        row,
        _finite(value),
        _finite(sigma[0]) if sigma else None,
        in_words(bits) if bits else "",
        place if place and np.isfinite(place).all() else None,
    )


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
