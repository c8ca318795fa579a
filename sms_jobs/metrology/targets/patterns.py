"""What a board of dots is, and what is found of a board in an image."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import nan, pi
from typing import Literal, Protocol, TypeAlias

import numpy as np

from sms_jobs.metrology.arrays import Floats, Ints32

Place: TypeAlias = tuple[int, int]

_NEXT_PITCHES = 1.1
"""Across a seam: what is farther apart are no neighbours, see `check_artefact`."""


class DotBoard(Protocol):
    """What must be known of a board of dots; `sms_jobs.records.artefacts.CircleBoard` explains each."""

    @property
    def columns(self) -> int:
        """Number of columns."""
        ...

    @property
    def rows(self) -> int:
        """Number of rows."""
        ...

    @property
    def pitch_mm(self) -> float:
        """Distance of neighbours."""
        ...

    @property
    def dot_diameter_mm(self) -> float:
        """Diameter of an ordinary dot."""
        ...

    @property
    def diameter_mm(self) -> float:
        """Of the cylinder about which the sheet of dots is wrapped; infinite for a flat one."""
        ...

    @property
    def markers(self) -> tuple[Place, ...] | None:
        """Places of the markers, origin, x, y; of a cylinder others may follow."""
        ...

    @property
    def marker(self) -> Literal["ring", "larger-dot"]:
        """What a marker is."""
        ...

    @property
    def marker_diameter_mm(self) -> float:
        """Outer diameter of a marker, 0 where unknown."""
        ...

    @property
    def marker_hole_mm(self) -> float:
        """Inner diameter of a ring, 0 where unknown."""
        ...

    @property
    def ink(self) -> Literal["dark", "bright"]:
        """Whether dots are dark or bright."""
        ...


@dataclass(frozen=True)
class BoardPoints:
    """The points of a board that were found in an image.

    Attributes
    ----------
    place
        (n, 2), column and row on the board, sorted by row and column.
    point
        (n, 3), on the board, in mm, in the board's frame; of a cylinder on its sheet, see `wrapped_sheets`.
    centre_px
        (n, 2), images of the centres, corrected for perspective.
    covariance_px
        (n, 2, 2), of `centre_px`, in px squared.
    sigma_px
        (n,), standard deviation in each direction.
    ellipse_px
        (n, 2), centres of the ellipses, not corrected.
    radius_px
        (n,), geometric mean of an ellipse's semi-axes; 0 for the corners of a chessboard.
    blur_px
        Standard deviation of the blur of lens and pixel together, median over the dots; NaN where it is not
        found, as of a chessboard.
    markers_seen
        Number of markers that were found; 0 for boards without them.
    refused
        How many candidates were refused, by reason.
    reason
        Why the board was not found, empty where it was; without a board there are no points.
    """

    place: Ints32
    point: Floats
    centre_px: Floats
    covariance_px: Floats
    sigma_px: Floats
    ellipse_px: Floats
    radius_px: Floats
    blur_px: float = nan
    markers_seen: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    reason: str = ""


def not_found(reason: str, refused: dict[str, int]) -> BoardPoints:
    """Return the result of a search that failed."""
    none = np.empty
    return BoardPoints(
        none((0, 2), np.int32),
        none((0, 3)),
        none((0, 2)),
        none((0, 2, 2)),
        none(0),
        none((0, 2)),
        none(0),
        refused=refused,
        reason=reason,
    )


def board_points(board: DotBoard, place: Ints32) -> Floats:
    """Return the points (n, 3) in mm, in the frame of the board's sheet, of places (n, 2) of column and row.

    The origin is the first marker, x runs along the columns towards the second, y along the rows towards
    the third, z = x cross y. Without markers the origin is place (0, 0), and x and y grow with column and
    row. Of a cylinder the sheet touches at the origin.
    """
    points = np.zeros((len(place), 3))
    origin = np.zeros(2) if board.markers is None else np.array(board.markers[0], dtype=np.float64)
    points[:, :2] = (np.asarray(place, np.float64) - origin) * _signs(board.markers) * board.pitch_mm
    return points


def _signs(markers: tuple[Place, ...] | None) -> Floats:
    """Return whether x and y grow with column and row, 1, or fall, -1."""
    if markers is None:
        return np.ones(2)
    first, second, third = (np.array(m, dtype=np.float64) for m in markers[:3])
    return np.array([np.sign(second[0] - first[0]), np.sign(third[1] - first[1])])


def radius_of(board: DotBoard) -> float:
    """Return the radius in mm about which a board's sheet is wrapped, as `wrapped_sheets` has it.

    From outside, columns run to the right and rows downwards: where x and y run as they do or both against
    them, z points into the cylinder.
    """
    return 0.5 * board.diameter_mm * float(np.prod(_signs(board.markers)))


def seam_pitches(board: DotBoard) -> float:
    """Return how far the first column is from the last across the seam, in pitches; infinite if flat."""
    return pi * board.diameter_mm / board.pitch_mm - (board.columns - 1)


def goes_around(board: DotBoard) -> bool:
    """Tell whether neighbours stand at both sides of the seam, as far as a lattice goes."""
    return seam_pitches(board) < _NEXT_PITCHES
