"""Parts of an image that somebody chose: rectangles and polygons, written as a line of text.

`rectangle 100 80 420 360 - polygon 200 150 260 150 230 210` is a rectangle less a triangle: each shape adds
to what stands before it, or, after a minus, is taken away. The whole image stands before a first minus.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from typing import Final

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask

_FRACTION_BITS: Final = 6  # corners are taken to 1/64 px
_LARGEST: Final = 1e6  # px
_WORDS: Final = ("rectangle", "polygon")


@dataclass(frozen=True)
class Outline:
    """A closed polygon, corners (n, 2) as x and y in px; whether it adds to the region or is taken away."""

    corners: Floats
    adds: bool = True


def parse_outlines(text: str) -> tuple[Outline, ...]:
    """Read shapes from text; see this module for how they are written.

    Raises
    ------
    ValueError
        The text names no shape or has too few numbers, or what is no number.
    """
    words = text.replace(",", " ").split()
    outlines: list[Outline] = []
    adds, shape = True, ""
    for is_number, group in groupby(words, key=lambda word: word not in (*_WORDS, "+", "-")):
        for word in [] if is_number else list(group):
            if shape:
                raise ValueError(f"'{shape}' has no numbers before '{word}'")
            if word in _WORDS:
                shape = word
            else:
                adds = word == "+"
        if is_number:
            outlines.append(Outline(_corners(shape, list(group)), adds))
            adds, shape = True, ""
    if shape or not outlines or words[-1] in "+-":
        raise ValueError(
            f"'{text}' ends without a shape's numbers; write 'rectangle LEFT TOP RIGHT BOTTOM' or "
            "'polygon X Y X Y X Y', in px"
        )
    return tuple(outlines)


def _corners(shape: str, words: list[str]) -> Floats:
    """Return the corners of a shape from its numbers."""
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        raise ValueError(
            f"'{' '.join(words[:8])}' has a word that is no number; outlines are written as "
            "'rectangle LEFT TOP RIGHT BOTTOM' or 'polygon X Y X Y X Y', in px"
        ) from None
    if not (np.abs(numbers) <= _LARGEST).all():
        raise ValueError(f"a corner of the {shape} lies beyond {_LARGEST:g} px")
    if shape == "rectangle":
        if len(numbers) != 4 or numbers[2] < numbers[0] or numbers[3] < numbers[1]:
            raise ValueError(
                f"a rectangle has LEFT TOP RIGHT BOTTOM, in px, RIGHT at or beyond LEFT and BOTTOM at or "
                f"below TOP, and not '{' '.join(words[:8])}'"
            )
        left, top, right, bottom = numbers
        return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    if shape != "polygon":
        raise ValueError(f"'{' '.join(words[:4])}' is incomplete; write 'rectangle' or 'polygon' before it")
    if len(numbers) < 6 or len(numbers) % 2:
        raise ValueError(f"a polygon has three corners or more, X Y each, and not {len(numbers)} numbers")
    return np.asarray(numbers.reshape(-1, 2))


def inside_outlines(outlines: tuple[Outline, ...], shape: tuple[int, int]) -> Mask:
    """Return which pixels (rows, columns) lie in the region, those on an outline with it."""
    import cv2

    filled = np.full(shape, 0 if outlines[0].adds else 1, np.uint8)
    for outline in outlines:
        corners = np.rint(outline.corners * (1 << _FRACTION_BITS)).astype(np.int32)
        cv2.fillPoly(filled, [corners[:, None]], int(outline.adds), shift=_FRACTION_BITS)
    return filled > 0


def outlines_of(mask: Mask) -> tuple[Outline, ...]:
    """Return polygons that fill exactly the pixels of a mask (rows, columns): holes are taken away again.

    Raises
    ------
    ValueError
        The mask is empty.
    """
    import cv2

    if not mask.any():
        raise ValueError("the mask has no pixel that counts")
    outlines: list[Outline] = []
    rest, adds = np.asarray(mask), True
    # Pieces, then the holes within them, then islands in these.
    while rest.any():
        contours, _ = cv2.findContours(rest.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        layer = tuple(Outline(_three(contour[:, 0].astype(np.float64)), adds) for contour in contours)
        outlines += layer
        filled = inside_outlines(tuple(Outline(one.corners) for one in layer), mask.shape)
        rest, adds = filled & ~rest, not adds
    return tuple(outlines)


def _three(corners: Floats) -> Floats:
    """Return at least three corners: a pixel or a line is a polygon too."""
    return corners[np.maximum(np.arange(max(len(corners), 3)) - max(3 - len(corners), 0), 0)]


def written(outlines: tuple[Outline, ...]) -> str:
    """Return outlines as `parse_outlines` reads them."""
    return " ".join(
        ("" if outline.adds else "- ")
        + "polygon "
        + " ".join(f"{value:g}" for value in outline.corners.ravel())
        for outline in outlines
    )
