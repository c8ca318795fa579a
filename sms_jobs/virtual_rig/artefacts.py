"""How boards, cylinders and the ball bar are made: where points, edges and spheres lie in their own frames.

A board is seen from its front alone, columns running to the right and rows down. Which way the axes of its
frame run follows from its markers; where y runs down, z points into the board, away from who looks at it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.artefacts import BallBar, Chessboard, CircleBoard, DotCylinder
from sms_jobs.records.scene import Bow, Deformation, Vector

Board: TypeAlias = CircleBoard | DotCylinder | Chessboard

BORDER_PITCHES = 2.0
"""From the outermost inner corners of a chessboard to its edge: one square and a white border as wide."""


@dataclass(frozen=True)
class BoardAxes:
    """Where a board's frame lies on its grid.

    Attributes
    ----------
    column, row
        Place of the origin.
    x_right
        1.0 where x runs to the right as the board is seen from the front, -1.0 where it runs to the left.
    y_down
        1.0 where y runs down, -1.0 where it runs up.
    """

    column: int
    row: int
    x_right: float
    y_down: float


def axes_of(board: Board) -> BoardAxes:
    """Return where a board's frame lies on its grid.

    Raises
    ------
    InvalidInput
        When the markers of a circle board do not define a frame.
    """
    if isinstance(board, Chessboard) or board.markers is None:
        return BoardAxes(0, 0, 1.0, 1.0)
    (column, row), (second, second_row), (third_column, third) = board.markers[:3]
    if second_row != row or third_column != column or second == column or third == row:
        raise InvalidInput(
            f"the markers {board.markers[:3]} of a {board.shape} define no axes: the second must share the "
            "row of the first, the third its column, given as (column, row)"
        )
    return BoardAxes(column, row, float(np.sign(second - column)), float(np.sign(third - row)))


def board_points(board: Board) -> tuple[NDArray[np.int32], Floats]:
    """Return the places (column, row) of a board's points, (n, 2), and the points in its frame, (n, 3), mm.

    Row by row: the centres of dots, or inner corners.
    """
    places, sheet = _sheet(board)
    if not isinstance(board, DotCylinder):
        return places, sheet
    out = 0.5 * board.diameter_mm * outwards(board, sheet[:, 0])
    return places, axis_of(board) + [0.0, 1.0, 0.0] * sheet + out


def board_normals(board: Board) -> Floats:
    """Return the unit vectors, in the board's frame, from its points towards who looks at them, (n, 3)."""
    return outwards(board, _sheet(board)[1][:, 0])


def _sheet(board: Board) -> tuple[NDArray[np.int32], Floats]:
    """Return the places of a board's points, and the points (n, 3) as if it were flat."""
    axes = axes_of(board)
    rows, columns = np.mgrid[: board.rows, : board.columns]
    places = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(np.int32)
    steps = (places - [axes.column, axes.row]) * [axes.x_right, axes.y_down]
    return places, np.pad(board.pitch_mm * steps, ((0, 0), (0, 1)))


def axis_of(cylinder: DotCylinder) -> Floats:
    """Return the point of a cylinder's axis beside the origin of its frame, (3,), in mm."""
    axes = axes_of(cylinder)
    return np.array([0.0, 0.0, 0.5 * cylinder.diameter_mm * axes.x_right * axes.y_down])


def outwards(board: Board, x: Floats) -> Floats:
    """Return the unit vectors (n, 3) from places at x (n,) of a board's sheet towards who looks at them."""
    axes = axes_of(board)
    into = axes.x_right * axes.y_down
    turn = 2.0 * x / board.diameter_mm if isinstance(board, DotCylinder) else np.zeros(len(x))
    return np.stack([np.sin(turn), np.zeros_like(turn), -into * np.cos(turn)], axis=-1)


def bowed(board: Board, bow_mm: Vector) -> tuple[Deformation, ...]:
    """Return what gives a board a bow along x and y and a twist, in mm; nothing for a flat one.

    Raises
    ------
    InvalidInput
        When a cylinder is to be bowed.
    """
    if not any(bow_mm):
        return ()
    if isinstance(board, DotCylinder):
        raise InvalidInput(
            f"a {board.shape} has no bow: leave scene.board_bow_mm out, or make another diameter_mm true"
        )
    _, points = board_points(board)
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    (x, y), (half_x, half_y) = (0.5 * (low + high)).tolist(), (0.5 * (high - low)).tolist()
    return (Bow(*bow_mm, (x, y), half_x, half_y),)


def edges_mm(board: Board) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top edge from the origin, in mm to the right and upwards.

    A circle board without a margin gets one of a pitch.
    """
    axes = axes_of(board)
    if isinstance(board, Chessboard):
        margin = BORDER_PITCHES * board.pitch_mm
    else:
        margin = board.margin_mm or board.pitch_mm
    return (
        -axes.column * board.pitch_mm - margin,
        (board.columns - 1 - axes.column) * board.pitch_mm + margin,
        (axes.row - board.rows + 1) * board.pitch_mm - margin,
        axes.row * board.pitch_mm + margin,
    )


def bar_centres(bar: BallBar) -> Floats:
    """Return the centres of spheres 1 and 2 in the bar's frame, (2, 3), mm; see thesis section 3.3."""
    half = bar.length_mm / 2.0
    return np.array([[bar.stalk_mm, 0.0, bar.slide_mm - half], [bar.stalk_mm, 0.0, bar.slide_mm + half]])
