"""Speckle to be printed: a picture or a page of exact physical size (thesis section 6.2.2)."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.records.scene import Speckle
from sms_jobs.virtual_rig.laser_speckle import (
    WIDTH_TIMES_APERTURE,
    Aperture,
    LaserSpeckle,
    laser_speckle,
    rough_light,
)
from sms_jobs.virtual_rig.speckle import speckle_image

Pattern = Literal["dots", "laser"]
"""Round black dots, or laser speckle, which the thesis printed."""

MM_PER_INCH = 25.4
_MOST_PIXELS = 400_000_000
_WHITE = 3.0  # times the mean brightness of laser speckle, beyond which all is white: 5 % of it


@dataclass(frozen=True)
class Sheet:
    """A sheet of speckle.

    Attributes
    ----------
    width_mm, height_mm
        Of the printed area.
    speckle_mm
        Mean diameter of a dot; of laser speckle the full width at half maximum of the autocorrelation.
    dpi
        Printed dots an inch.
    seed
        Of the pattern.
    mirrored
        Left and right exchanged, for transfer paper, which is put on face down.
    pattern
        What speckles look like.
    """

    width_mm: float
    height_mm: float
    speckle_mm: float
    dpi: int = 600
    seed: int = 1
    mirrored: bool = False
    pattern: Pattern = "dots"


def speckle_sheet(sheet: Sheet) -> NDArray[np.uint8]:
    """Return the sheet's dots, (rows, columns): 0 black, 255 white, grey where an edge crosses a dot.

    Laser speckle has all greys. Raises `InvalidInput` when the sheet has too many dots, when a speckle has
    fewer than four across, and when one of laser speckle is as large as the sheet.
    """
    pitch = MM_PER_INCH / sheet.dpi
    columns, rows = round(sheet.width_mm / pitch), round(sheet.height_mm / pitch)
    if columns * rows > _MOST_PIXELS:
        raise InvalidInput(
            f"a sheet of {sheet.width_mm:g} mm x {sheet.height_mm:g} mm at {sheet.dpi} dpi has "
            f"{columns * rows / 1e6:.0f} million dots, more than {_MOST_PIXELS // 10**6} million; "
            "print it in parts or with fewer `dpi`"
        )
    if sheet.speckle_mm < 4.0 * pitch:
        raise InvalidInput(
            f"speckles of {sheet.speckle_mm:g} mm have {sheet.speckle_mm / pitch:.1f} dots at "
            f"{sheet.dpi} dpi, fewer than 4; choose {4.0 * MM_PER_INCH / sheet.speckle_mm:.0f} dpi "
            "or more"
        )
    if sheet.pattern == "laser":
        light = _light(sheet, rows, columns)
        bright = np.minimum(laser_speckle(light) / _WHITE, 1.0)
    else:
        bright = speckle_image(Speckle(sheet.speckle_mm, 0.0, 1.0, sheet.seed), rows, columns, pitch)
    image = np.rint(255.0 * bright).astype(np.uint8)
    return np.ascontiguousarray(image[:, ::-1]) if sheet.mirrored else image


def _light(sheet: Sheet, rows: int, columns: int) -> Aperture:
    """Return the light behind which laser speckle is as wide as the sheet wants it."""
    pitch = MM_PER_INCH / sheet.dpi
    aperture = WIDTH_TIMES_APERTURE * pitch / sheet.speckle_mm
    widest_mm = WIDTH_TIMES_APERTURE * pitch * min(rows, columns)
    if sheet.speckle_mm > widest_mm:
        raise InvalidInput(
            f"laser speckle of {sheet.speckle_mm:g} mm is too large for a sheet of {sheet.width_mm:g} mm x "
            f"{sheet.height_mm:g} mm: choose {0.99 * widest_mm:.3g} mm or less"
        )
    return rough_light(LaserSpeckle(aperture, sheet.seed), rows, columns)


def as_png(sheet: Sheet) -> bytes:
    """Return a sheet as PNG whose dots a metre say how large it is."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(speckle_sheet(sheet)).save(buffer, "PNG", dpi=(sheet.dpi, sheet.dpi))
    return buffer.getvalue()


def as_pdf(sheet: Sheet) -> bytes:
    """Return a sheet as a PDF page of its size, to be printed at 100 %."""
    import zlib

    image = speckle_sheet(sheet)
    rows, columns = image.shape
    points = [72.0 / MM_PER_INCH * size for size in (sheet.width_mm, sheet.height_mm)]
    page = f"q {points[0]:.6f} 0 0 {points[1]:.6f} 0 0 cm /Speckle Do Q".encode()
    packed = zlib.compress(image.tobytes(), 6)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        b"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 %.6f %.6f] /Contents 4 0 R "
        b"/Resources << /XObject << /Speckle 5 0 R >> >> >>" % (points[0], points[1]),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(page), page),
        b"<< /Type /XObject /Subtype /Image /Width %d /Height %d /ColorSpace /DeviceGray "
        b"/BitsPerComponent 8 /Filter /FlateDecode /Length %d >>\nstream\n%s\nendstream"
        % (columns, rows, len(packed), packed),
    ]
    out = bytearray(b"%PDF-1.4\n")
    places = []
    for number, body in enumerate(objects, start=1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    start = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    for place in places:
        out += b"%010d 00000 n \n" % place
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, start)
    return bytes(out)
