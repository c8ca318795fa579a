"""The things that a rig is calibrated with: boards of dots or squares, cylinders of dots, the ball bar."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal, TypeAlias

Place: TypeAlias = tuple[int, int]
"""A place on a board: (column, row), counted from 0."""


@dataclass(frozen=True)
class CircleBoard:
    """A flat board with a regular grid of dots, three of which may be markers.

    Columns run to the right and rows downwards as the board is seen from the front. The markers tell the
    board's frame: its origin is the centre of the first, its x axis runs along the columns towards the
    second, its y axis along the rows towards the third, and z = x cross y. Without markers the origin is a
    dot at a corner of the grid, x and y as for a chessboard.

    Attributes
    ----------
    columns, rows
        Number of dots along each direction.
    pitch_mm
        Distance between the centres of neighbours.
    dot_diameter_mm
        Of an ordinary dot.
    markers
        Places of the markers: origin, x, y. The second shares the row of the first, the third its column.
        None for a board without, which nobody can tell from itself turned by half a turn.
    marker
        Whether markers are rings or larger dots.
    marker_diameter_mm
        Outer diameter of a marker.
    marker_hole_mm
        Inner diameter of a ring; 0 for larger dots.
    ink
        Whether dots are darker or brighter than the ground.
    margin_mm
        From the centres of the outermost dots to the edge of the board.
    pitch_relative_sigma
        Relative standard deviation of the pitch: how well the board's scale is known. None where nobody has
        told it: then what is calibrated with the board alone has the scale of the nominal pitch.
    point_sigma_mm
        Standard deviation of one dot's place on the board, in each direction.
    flatness_mm
        Standard deviation of how far the board is bowed, from the middle of its points to their ends, and
        twisted; 0 for one that is taken as flat, None where nobody has told it: see `bow_sigma_mm`.
    """

    columns: int
    rows: int
    pitch_mm: float
    dot_diameter_mm: float
    markers: tuple[Place, Place, Place] | None = None
    marker: Literal["ring", "larger-dot"] = "ring"
    marker_diameter_mm: float = 0.0
    marker_hole_mm: float = 0.0
    ink: Literal["dark", "bright"] = "dark"
    margin_mm: float = 0.0
    pitch_relative_sigma: float | None = None
    point_sigma_mm: float = 0.002
    flatness_mm: float | None = None
    shape: Literal["circle-board"] = "circle-board"

    @property
    def diameter_mm(self) -> float:
        """A flat board is a sheet about an infinite cylinder."""
        return inf


@dataclass(frozen=True)
class DotCylinder:
    """A cylinder with a regular grid of dots around its outside: a sheet as of a `CircleBoard`, wrapped.

    Columns run around to the right as the cylinder is seen from outside, rows along its axis downwards. The
    frame is that of the sheet where it touches at the first marker, or at place (0, 0): x runs around there,
    y along the axis, and z = x cross y goes through the axis.

    Attributes
    ----------
    columns, rows
        Number of dots around and along the axis. The grid goes all around or leaves a seam without dots.
    pitch_mm
        Distance between the centres of neighbours, around measured along the outside.
    dot_diameter_mm, marker, marker_diameter_mm, marker_hole_mm, ink, margin_mm, pitch_relative_sigma
        See `CircleBoard`; a dot is a disc on the sheet.
    diameter_mm
        Of the outside on which the dots are.
    markers
        Places of the markers: origin, x and y as of a `CircleBoard`, then any number of others, by which a
        camera that does not see the first three tells what it sees.
    point_sigma_mm
        Standard deviation of one dot's place on the cylinder, in each direction.
    diameter_sigma_mm
        Standard deviation of the diameter; None where nobody has told it: see `diameter_sigma_mm`.
    """

    columns: int
    rows: int
    pitch_mm: float
    dot_diameter_mm: float
    diameter_mm: float
    markers: tuple[Place, ...] | None = None
    marker: Literal["ring", "larger-dot"] = "ring"
    marker_diameter_mm: float = 0.0
    marker_hole_mm: float = 0.0
    ink: Literal["dark", "bright"] = "dark"
    margin_mm: float = 0.0
    pitch_relative_sigma: float | None = None
    point_sigma_mm: float = 0.002
    diameter_sigma_mm: float | None = None
    shape: Literal["dot-cylinder"] = "dot-cylinder"


@dataclass(frozen=True)
class Chessboard:
    """A chessboard, known by its inner corners.

    Its origin is an inner corner at an end of the grid, x runs along its columns, y along its rows.

    Attributes
    ----------
    columns, rows
        Number of inner corners along each direction.
    pitch_mm
        Side of a square.
    pitch_relative_sigma, point_sigma_mm, flatness_mm
        See `CircleBoard`.
    """

    columns: int
    rows: int
    pitch_mm: float
    pitch_relative_sigma: float | None = None
    point_sigma_mm: float = 0.002
    flatness_mm: float | None = None
    shape: Literal["chessboard"] = "chessboard"


@dataclass(frozen=True)
class BallBar:
    """Two spheres on a bar, held by a pan-tilt stage.

    In the bar's frame, whose origin is where the stage's axes meet, the bar runs along z and the stalk that
    holds it along x (thesis Eq. (2.2)): sphere 1 is at (stalk, 0, slide - length / 2), sphere 2 at
    (stalk, 0, slide + length / 2).

    Attributes
    ----------
    length_mm, length_sigma_mm
        Certified distance of the spheres' centres, and its standard deviation: the scale of a calibration.
    radius_mm, radius_sigma_mm
        Of each sphere.
    stalk_mm, slide_mm
        As mounted, nominal: how far the bar is from the axes, and its middle from the clamp.
    """

    length_mm: float
    length_sigma_mm: float
    radius_mm: float
    radius_sigma_mm: float
    stalk_mm: float = 0.0
    slide_mm: float = 0.0
    shape: Literal["ball-bar"] = "ball-bar"


_UNKNOWN_FLATNESS = 2e-3
"""Of the longer side: a print on a plate of aluminium or glass is flatter, one on cardboard may not be.
Of a diameter: drawn tubes are as good."""


def bow_sigma_mm(board: CircleBoard | Chessboard) -> float:
    """Return the standard deviation of a board's bow and twist, mm: 1/500 of its longer side if not told."""
    if board.flatness_mm is not None:
        return board.flatness_mm
    return _UNKNOWN_FLATNESS * board.pitch_mm * (max(board.columns, board.rows) - 1)


def diameter_sigma_mm(cylinder: DotCylinder) -> float:
    """Return the standard deviation of a cylinder's diameter, mm: 1/500 of it if not told."""
    if cylinder.diameter_sigma_mm is not None:
        return cylinder.diameter_sigma_mm
    return _UNKNOWN_FLATNESS * cylinder.diameter_mm


Artefact: TypeAlias = CircleBoard | DotCylinder | Chessboard | BallBar
