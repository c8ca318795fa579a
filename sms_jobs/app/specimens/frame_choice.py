"""How a specimen's frame is to be found: what a person points at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from sms_jobs.errors import InvalidInput

Place: TypeAlias = tuple[float, ...]
"""A pixel, column and row, of the reference image, or X, Y, Z of the world in mm."""


@dataclass(frozen=True)
class Choice:
    """How a frame is to be found.

    Attributes
    ----------
    x
        A point of the x axis.
    origin
        None for the middle of the region.
    plane
        A third point, of the xy plane; None where a plane is fitted.
    region
        Outlines of a region of the image, as correlate takes them, to whose surface a plane is fitted.
    view
        Whose reference surface pixels are of; the first that measures shape if it is None.
    markers
        Whether pixels point at round marks, whose middles are taken.
    """

    x: Place
    origin: Place | None = None
    plane: Place | None = None
    region: str = ""
    view: str | None = None
    markers: bool = False


def in_world(choice: Choice) -> bool:
    """Say whether the points are of the world; `InvalidInput` where they are neither, or of both."""
    sizes = {len(one) for one in (choice.origin, choice.x, choice.plane) if one is not None}
    if sizes not in ({2}, {3}):
        raise InvalidInput(
            "give all points as pixels, column,row, or all as places of the world, X,Y,Z in mm"
        )
    if (choice.plane is None) == (not choice.region):
        raise InvalidInput("give `plane`, a third point, or `fit`, a region to fit a plane to; not both")
    if choice.origin is None and not choice.region:
        raise InvalidInput("give `origin`; only a fitted region has a middle that can replace it")
    if sizes == {3} and (choice.region or choice.markers or choice.view):
        raise InvalidInput("`fit`, `markers` and `view` need pixels; give the points as column,row")
    return sizes == {3}
