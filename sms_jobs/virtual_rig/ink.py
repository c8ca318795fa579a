"""What is printed on a board: the share of a camera sub-sample's footprint that ink covers.

The footprint is the parallelogram that a sub-sample's square is seen as on the board. A dot's share of it
is integrated along lines, exactly along each; an edge between two squares is taken exactly. So a printed
dot is where it belongs however few pixels it has.
"""

from __future__ import annotations

from math import floor, hypot, sqrt

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, uncounted_kernel
from sms_jobs.records.artefacts import BallBar, Chessboard, CircleBoard, DotCylinder
from sms_jobs.records.scene import Surface
from sms_jobs.virtual_rig.artefacts import axes_of

DARK, BRIGHT = 0.1, 0.85
"""Diffuse reflectance of dark and of bright parts of an artefact."""

SPECIMEN, PLAIN, DOTS, SQUARES = 0, 1, 2, 3

_DOT_LINES = 8
_CORNER_LINES = 16


def packed_ink(surface: Surface) -> Floats:
    """Return what is printed on a surface as kernels take it, (17,) or more.

    0 kind (0: no artefact), 1 reflectance of the ground, 2 of the ink, 3 pitch, 4 - 5 column and row of the
    patch's origin, 6 - 7 columns and rows, 8 radius of a dot, 9 - 10 outer and inner radius of a marker, 11
    and on places of the markers, off the board where it has none.
    """
    ink = np.zeros(17)
    if isinstance(surface, BallBar):
        ink[:3] = PLAIN, BRIGHT, BRIGHT
    elif isinstance(surface, Chessboard):
        ink[:8] = SQUARES, BRIGHT, DARK, surface.pitch_mm, 0, 0, surface.columns, surface.rows
    elif isinstance(surface, CircleBoard | DotCylinder):
        axes = axes_of(surface)
        tones = (BRIGHT, DARK) if surface.ink == "dark" else (DARK, BRIGHT)
        around = isinstance(surface, DotCylinder)
        column = 0.5 * (surface.columns - 1) if around else axes.column
        grid = (surface.pitch_mm, column, axes.row, surface.columns, surface.rows)
        hole = surface.marker_hole_mm if surface.marker == "ring" else 0.0
        radii = (surface.dot_diameter_mm / 2.0, surface.marker_diameter_mm / 2.0, hole / 2.0)
        markers = surface.markers or ((-1, -1),) * 3
        return np.array([DOTS, *tones, *grid, *radii, *np.ravel(markers)], dtype=np.float64)
    return ink


@inner
@uncounted_kernel
def printed_reflectance(ink: Floats, a: float, b: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Return the diffuse reflectance of an artefact, averaged over a footprint about (a, b).

    (ax, bx) and (ay, by) are the sides of the footprint, in mm, a to the right and b upwards.
    """
    if ink[0] == PLAIN:
        return float(ink[1])
    right, down = a / ink[3] + ink[4], ink[5] - b / ink[3]
    if ink[0] == SQUARES:
        share = _squares(ink, right, down, ax / ink[3], ay / ink[3], -bx / ink[3], -by / ink[3])
        return float(ink[1] + (ink[2] - ink[1]) * share)
    column, row = floor(right + 0.5), floor(down + 0.5)
    if not (0 <= column < ink[6] and 0 <= row < ink[7]):
        return float(ink[1])
    a, b = (right - column) * ink[3], (row - down) * ink[3]
    outer, inner = ink[8], 0.0
    for m in range(11, len(ink), 2):
        if column == ink[m] and row == ink[m + 1]:
            outer, inner = ink[9], ink[10]
    share = disc_share(a, b, ax, ay, bx, by, outer)
    if inner > 0.0:
        share -= disc_share(a, b, ax, ay, bx, by, inner)
    return float(ink[1] + (ink[2] - ink[1]) * share)


@inner
@uncounted_kernel
def disc_share(a: float, b: float, ax: float, ay: float, bx: float, by: float, radius: float) -> float:
    """Return the share of a footprint about (a, b) that a disc about (0, 0) covers.

    Midpoint rule over lines of the footprint that run across the disc's edge, exact along each: the error
    is about 1e-3 where the edge is curved and much less where it is straight.
    """
    reach = 0.5 * hypot(abs(ax) + abs(ay), abs(bx) + abs(by))
    distance = hypot(a, b)
    if distance >= radius + reach:
        return 0.0
    if distance <= radius - reach:
        return 1.0
    if abs(a * ax + b * bx) < abs(a * ay + b * by):
        ax, ay, bx, by = ay, ax, by, bx
    squared = ax * ax + bx * bx
    total = 0.0
    for k in range(_DOT_LINES):
        v = (k + 0.5) / _DOT_LINES - 0.5
        p, q = a + v * ay, b + v * by
        along = -(p * ax + q * bx) / squared
        under = along * along - (p * p + q * q - radius * radius) / squared
        if under > 0.0:
            half = sqrt(under)
            total += max(min(along + half, 0.5) - max(along - half, -0.5), 0.0)
    return total / _DOT_LINES


@inner
@uncounted_kernel
def _squares(ink: Floats, x: float, y: float, xu: float, xv: float, yu: float, yv: float) -> float:
    """Return the share of a footprint that dark squares cover; all in pitches, x right and y down.

    The squares lie between whole numbers from -1 to `columns` and `rows`, the outermost corner dark.
    """
    i, j = min(max(floor(x + 0.5), -1.0), ink[6]), min(max(floor(y + 0.5), -1.0), ink[7])
    x, y = x - i, y - j
    before_x, before_y = edge_share(x, xu, xv), edge_share(y, yu, yv)
    both = before_x * before_y
    if 0.0 < before_x < 1.0 and 0.0 < before_y < 1.0:
        both = _quarter_share(x, y, xu, xv, yu, yv)
    shares = (both, before_x - both, before_y - both, 1.0 - before_x - before_y + both)
    total = 0.0
    for quarter in range(4):
        p = i - 1.0 if quarter < 2 else i
        q = j - 1.0 if quarter % 2 == 0 else j
        if -1.0 <= p < ink[6] and -1.0 <= q < ink[7] and int(p + q) % 2 == 0:
            total += shares[quarter]
    return total


@inner
@uncounted_kernel
def edge_share(x: float, xu: float, xv: float) -> float:
    """Return the share of the unit square |u|, |v| <= 1/2 where x + xu u + xv v < 0."""
    p, q = max(abs(xu), abs(xv)), min(abs(xu), abs(xv))
    outside = 0.5 * (p + q) - abs(x)
    if outside <= 0.0:
        return 1.0 if x < 0.0 else 0.0
    if abs(x) <= 0.5 * (p - q):
        return 0.5 - x / p
    corner = outside * outside / (2.0 * p * q)
    return corner if x > 0.0 else 1.0 - corner


@inner
@uncounted_kernel
def _quarter_share(x: float, y: float, xu: float, xv: float, yu: float, yv: float) -> float:
    """Return the share of the unit square where x + xu u + xv v < 0 and y + yu u + yv v < 0."""
    inside = 0
    for m in range(_CORNER_LINES):
        v = (m + 0.5) / _CORNER_LINES - 0.5
        for n in range(_CORNER_LINES):
            u = (n + 0.5) / _CORNER_LINES - 0.5
            inside += x + xu * u + xv * v < 0.0 and y + yu * u + yv * v < 0.0
    return inside / (_CORNER_LINES * _CORNER_LINES)
