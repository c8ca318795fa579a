"""Regions of interest: what is written is what is inside, and masks come back pixel by pixel."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage
from support.command import sms

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.masks import region_of_mask
from sms_jobs.metrology.images.region_of_interest import (
    inside_outlines,
    outlines_of,
    parse_outlines,
    written,
)

SHAPE = (40, 60)


def inside(text: str) -> np.ndarray:
    return inside_outlines(parse_outlines(text), SHAPE)


def test_a_rectangle_holds_its_corners_and_no_more() -> None:
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    expected = (x >= 5) & (x <= 20) & (y >= 3) & (y <= 30)
    np.testing.assert_array_equal(inside("rectangle 5 3 20 30"), expected)
    np.testing.assert_array_equal(inside("rectangle 5,3,20,30"), expected)
    np.testing.assert_array_equal(inside("- rectangle 5 3 20 30"), ~expected)
    np.testing.assert_array_equal(inside("rectangle 5 3 20 30 - rectangle 10 3 20 30"), expected & (x < 10))
    both = inside("rectangle 5 3 20 30 rectangle 40 3 50 30")
    np.testing.assert_array_equal(both, expected | ((x >= 40) & (x <= 50) & (y >= 3) & (y <= 30)))


def test_a_polygon_holds_the_pixels_whose_middles_it_holds() -> None:
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    triangle = inside("polygon 5 5 45 5 5 35")
    depth = 1.0 - (x - 5) / 40.0 - (y - 5) / 30.0
    within = (x >= 5) & (y >= 5)
    # Pixels on the slanting side, a pixel being 1 / 24 along its normal, may be counted or not.
    assert triangle[within & (depth > 0.04)].all()
    assert not triangle[~within | (depth < -0.04)].any()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_any_mask_comes_back_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = ndimage.gaussian_filter(rng.normal(size=SHAPE), seed - 0.7) > 0.0
    text = written(outlines_of(mask))
    np.testing.assert_array_equal(inside_outlines(parse_outlines(text), SHAPE), mask)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "ends without a shape's numbers"),
        ("rectangle", "ends without a shape's numbers"),
        ("rectangle - polygon 1 2 3 4 5 6", "'rectangle' has no numbers before '-'"),
        ("rectangle 1 2 3", "a rectangle has LEFT TOP RIGHT BOTTOM"),
        ("rectangle 9 2 3 8", "RIGHT at or beyond LEFT"),
        ("polygon 1 2 3 4", "three corners or more"),
        ("polygon 1 2 3 4 5 6 7", "not 7 numbers"),
        ("circle 1 2 3", "no number.*are written as 'rectangle LEFT TOP"),
        ("polygon 1 2 3 four 5 6", "no number"),
        ("polygon 1 2 3 nan 5 6", "beyond"),
        ("1 2 3 4", "is incomplete"),
    ],
)
def test_what_is_no_region_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_outlines(text)


def test_a_mask_image_becomes_text(tmp_path: Path) -> None:
    mask = np.zeros(SHAPE, np.uint8)
    mask[10:30, 5:50] = 255
    mask[15:20, 20:25] = 0
    path = tmp_path / "mask.png"
    cv2.imwrite(str(path), mask)
    np.testing.assert_array_equal(inside(region_of_mask(path).text), mask > 0)
    cv2.imwrite(str(path), 0 * mask)
    with pytest.raises(InvalidInput, match="paint what counts white"):
        region_of_mask(path)
    path.write_bytes(b"no image")
    with pytest.raises(InvalidInput, match="is no image, or is damaged"):
        region_of_mask(path)
    with pytest.raises(NotFound, match=r"missing\.png"):
        region_of_mask(tmp_path / "missing.png")


def test_the_command_prints_it(tmp_path: Path) -> None:
    mask = np.zeros(SHAPE, np.uint8)
    mask[10:30, 5:50] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    shown = sms("data", "outline", str(tmp_path / "mask.png"))
    assert shown.returncode == 0
    np.testing.assert_array_equal(inside(shown.stdout.strip()), mask > 0)
    assert f"{SHAPE[1]} x {SHAPE[0]} px" in shown.stderr


def test_a_picture_with_a_black_background_is_a_mask(tmp_path: Path) -> None:
    """Its speckle is dark in places and its background has specks: both are small."""
    mask = np.zeros((60, 80), dtype=bool)
    mask[10:50, 10:70] = True
    mask[20:30, 30:40] = False
    levels = np.where(mask, 90, 0).astype(np.uint8)
    levels[12, 12:15] = 0
    levels[40, 40] = 255
    levels[2, 2:5] = 7
    path = tmp_path / "blacked.png"
    cv2.imwrite(str(path), levels)
    found = inside_outlines(parse_outlines(region_of_mask(path, above=0.0, least_px=50).text), mask.shape)
    np.testing.assert_array_equal(found, mask)
