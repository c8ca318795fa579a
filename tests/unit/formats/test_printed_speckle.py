"""Printed speckle is as large as it says, and always the same."""

from __future__ import annotations

import io
import re
import zlib

import numpy as np
import pytest
from PIL import Image

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.printed_speckle import Sheet, as_pdf, as_png, speckle_sheet
from sms_jobs.metrology.images.texture_quality import speckle_width

SHEET = Sheet(40.0, 25.0, 1.0, 300)


def test_a_png_says_how_large_it_is() -> None:
    image = Image.open(io.BytesIO(as_png(SHEET)))
    across, down = (size / dpi * 25.4 for size, dpi in zip(image.size, image.info["dpi"], strict=True))
    # Half a dot of 25.4 / 300 mm, and whole dots a metre in the file: 1 / 11811 of the size.
    assert across == pytest.approx(40.0, abs=0.05)
    assert down == pytest.approx(25.0, abs=0.05)
    np.testing.assert_array_equal(np.asarray(image), speckle_sheet(SHEET))


def test_a_pdf_page_is_as_large_as_the_sheet_and_shows_it() -> None:
    page = as_pdf(SHEET)
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", page)
    drawn = re.search(rb"q ([\d.]+) 0 0 ([\d.]+) 0 0 cm", page)
    assert box is not None
    assert drawn is not None
    for found in (box, drawn):
        # Points of 1/72 inch with six decimals.
        assert [float(x) / 72.0 * 25.4 for x in found.groups()] == pytest.approx([40.0, 25.0], abs=1e-5)
    packed = page[page.index(b"/FlateDecode") :].split(b"stream\n", 1)[1].split(b"\nendstream")[0]
    image = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(speckle_sheet(SHEET).shape)
    np.testing.assert_array_equal(image, speckle_sheet(SHEET))
    # The table of places is what a reader trusts.
    for number, place in enumerate(re.findall(rb"(\d{10}) 00000 n", page), start=1):
        assert page[int(place) :].startswith(b"%d 0 obj" % number)


def test_speckles_are_as_large_as_asked_and_cover_half() -> None:
    image = speckle_sheet(SHEET).astype(float)
    large = speckle_sheet(Sheet(80.0, 50.0, 2.0, 300)).astype(float)
    # A single disc has 0.81 of its diameter; neighbours that keep their distance make it narrower.
    width = speckle_width(image, 0.0) * 25.4 / 300
    assert 0.5 < width < 0.81
    # The same pattern twice as large; widths are linear between dots of 0.08 mm, on both sides.
    assert speckle_width(large, 0.0) * 25.4 / 300 == pytest.approx(2.0 * width, abs=0.08)
    assert 0.35 < (image < 128).mean() < 0.6


def test_patterns_follow_their_seed_and_mirror() -> None:
    image = speckle_sheet(SHEET)
    np.testing.assert_array_equal(image, speckle_sheet(Sheet(40.0, 25.0, 1.0, 300)))
    assert (image != speckle_sheet(Sheet(40.0, 25.0, 1.0, 300, seed=2))).mean() > 0.3
    np.testing.assert_array_equal(speckle_sheet(Sheet(40.0, 25.0, 1.0, 300, mirrored=True)), image[:, ::-1])


def test_laser_speckle_is_as_wide_as_asked_in_all_greys() -> None:
    sheet = Sheet(60.0, 45.0, 1.0, 300, pattern="laser")
    image = speckle_sheet(sheet)
    # The mean width of a thousand speckles scatters by 2 % (test_laser_speckle); light cut off at white
    # makes the peak of the autocorrelation narrower by a few per cent.
    assert speckle_width(image.astype(float), 0.0) * 25.4 / 300 == pytest.approx(1.0, abs=0.1)
    # exp(-3) of the sheet is white, and 1 - exp(-0.3) of it has less than a tenth of that brightness.
    assert (image == 255).mean() == pytest.approx(0.05, abs=0.02)
    assert (image < 25.5).mean() == pytest.approx(0.26, abs=0.05)
    assert len(np.unique(image)) == 256


@pytest.mark.parametrize(
    ("sheet", "complaint"),
    [
        (Sheet(40.0, 25.0, 0.1, 300), "fewer than 4"),
        (Sheet(40.0, 25.0, 0.1, 300, pattern="laser"), "fewer than 4"),
        (Sheet(4000.0, 2500.0, 1.0, 600), "million dots"),
        (Sheet(40.0, 25.0, 13.0, 300, pattern="laser"), "choose 12.7 mm or less"),
    ],
)
def test_what_cannot_be_printed_is_refused(sheet: Sheet, complaint: str) -> None:
    with pytest.raises(InvalidInput, match=complaint):
        speckle_sheet(sheet)
