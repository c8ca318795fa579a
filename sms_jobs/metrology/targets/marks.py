"""Round marks on a specimen: the dot or ring that a person points at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.targets.circles import Circles, find_circles

_WINDOW_PX = 200
"""Half the side of the piece of the image that a mark is looked for in; marks are smaller by far."""
_LEAST_RADIUS_PX = 4.0  # speckles are smaller


@dataclass(frozen=True)
class Mark:
    """A round mark: its middle (column, row) in px with its covariance (2, 2), and its longer semi-axis."""

    centre: tuple[float, float]
    covariance: Floats
    radius_px: float


def mark_at(image: NDArray[np.generic], pixel: tuple[float, float]) -> Mark:
    """Return the round mark that a pixel lies in, dark or bright: of several the largest.

    Parameters
    ----------
    image
        (rows, columns), grey levels.
    pixel
        (column, row) in px.

    Raises
    ------
    InvalidInput
        The pixel lies in no dot or ring of 4 px radius or more.
    """
    rows, columns = image.shape
    column, row = pixel
    left, top = (max(int(one) - _WINDOW_PX, 0) for one in pixel)
    piece = image[top : min(int(row) + _WINDOW_PX, rows), left : min(int(column) + _WINDOW_PX, columns)]
    inks: tuple[Literal["dark", "bright"], ...] = ("dark", "bright")
    best: Mark | None = None
    for ink in inks if min(piece.shape, default=0) > 2 * _LEAST_RADIUS_PX else ():
        found = find_circles(piece, ink=ink)
        for mark in _about(found, np.array([column - left, row - top])):
            if best is None or mark.radius_px > best.radius_px:
                x, y = mark.centre
                best = Mark((x + left, y + top), mark.covariance, mark.radius_px)
    if best is None:
        raise InvalidInput(
            f"the pixel {column:g},{row:g} is in no round mark of {_LEAST_RADIUS_PX:g} px radius or more; "
            "point into a dot or ring, or leave out `markers` to take the pixel itself"
        )
    return best


def _about(found: Circles, pixel: Floats) -> list[Mark]:
    """Return the circles that a pixel lies in and that are large enough."""
    marks = []
    axes, _ = found.axes()
    for number in range(len(found.centre)):
        inside = np.linalg.norm(found.matrix[number] @ (pixel - found.centre[number])) <= 1.0
        if inside and axes[number, 1] >= _LEAST_RADIUS_PX:
            x, y = found.centre[number]
            marks.append(Mark((float(x), float(y)), found.covariance[number], float(axes[number, 0])))
    return marks
