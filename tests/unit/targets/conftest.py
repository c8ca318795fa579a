"""A draughtsman of boards: images of dots and squares under perspective and lens, exact to a thousandth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from sms_jobs.records.artefacts import CircleBoard

Floats = NDArray[np.float64]
SAMPLES = 4  # along a side of a pixel, of an edge that the lens has blurred before


@dataclass(frozen=True)
class View:
    """How a board is seen.

    `homography` maps the plane in mm, along columns and rows from place (0, 0), to undistorted px;
    `k1` then moves a point by k1 r^2 of its distance from the middle, r in units of `focal` px.
    """

    homography: Floats
    rows: int
    columns: int
    k1: float = 0.0
    focal: float = 600.0

    def image(self, points: Floats) -> Floats:
        mapped = points @ self.homography[:, :2].T + self.homography[:, 2]
        off = mapped[:, :2] / mapped[:, 2:] - self.middle()
        r2 = np.sum(off**2, axis=1, keepdims=True) / self.focal**2
        return np.asarray(self.middle() + off * (1.0 + self.k1 * r2))

    def middle(self) -> Floats:
        return np.array([0.5 * (self.columns - 1), 0.5 * (self.rows - 1)])

    def plane(self, pixels: Floats) -> Floats:
        wanted = pixels - self.middle()
        off = wanted.copy()
        for _ in range(12 if self.k1 else 0):
            off = wanted / (1.0 + self.k1 * np.sum(off**2, axis=1, keepdims=True) / self.focal**2)
        mapped = np.column_stack([off + self.middle(), np.ones(len(off))]) @ np.linalg.inv(self.homography).T
        return np.asarray(mapped[:, :2] / mapped[:, 2:])


def view_of(
    rows: int,
    columns: int,
    middle: tuple[float, float],
    px_per_mm: float,
    *,
    turn: float = 0.0,
    tilt: tuple[float, float] = (0.0, 0.0),
    k1: float = 0.0,
    focal: float = 600.0,
) -> View:
    """Return the view of a plane whose point `middle` (mm) is in the middle of the image.

    `turn` is about the optical axis, `tilt` about x and then y, in rad.
    """
    rotation = (
        cv2.Rodrigues(np.array([tilt[0], 0.0, 0.0]))[0]
        @ cv2.Rodrigues(np.array([0.0, tilt[1], 0.0]))[0]
        @ cv2.Rodrigues(np.array([0.0, 0.0, turn]))[0]
    )
    camera = np.array([[focal, 0.0, 0.5 * (columns - 1)], [0.0, focal, 0.5 * (rows - 1)], [0.0, 0.0, 1.0]])
    at = np.array([0.0, 0.0, focal / px_per_mm]) - rotation @ np.array([*middle, 0.0])
    return View(camera @ np.column_stack([rotation[:, 0], rotation[:, 1], at]), rows, columns, k1, focal)


Ink = Callable[[Floats], Floats]
"""Signed distance in mm from the nearest edge, negative in the ink, of points (n, 2) in mm."""


def dots(board: CircleBoard, hidden: frozenset[tuple[int, int]] = frozenset()) -> Ink:
    """Return the ink of a board of dots, some of which are not there."""
    markers = set() if board.markers is None else set(board.markers)

    def ink(points: Floats) -> Floats:
        place = np.rint(points / board.pitch_mm).astype(int)
        place = np.clip(place, 0, [board.columns - 1, board.rows - 1])
        r = np.hypot(*(points - place * board.pitch_mm).T)
        outer = np.full((board.columns, board.rows), 0.5 * board.dot_diameter_mm)
        hole = np.full((board.columns, board.rows), -1e3)
        for m in markers:
            outer[m] = 0.5 * (board.marker_diameter_mm or board.dot_diameter_mm)
            if board.marker == "ring":
                hole[m] = 0.5 * board.marker_hole_mm
        for h in hidden:
            outer[h] = -1e3
        at = place[:, 0], place[:, 1]
        return np.maximum(r - outer[at], hole[at] - r)

    return ink


def squares(columns: int, rows: int, pitch_mm: float) -> Ink:
    """Return the ink of a chessboard of inner corners; the square before the first corner is dark."""

    def ink(points: Floats) -> Floats:
        inside = np.minimum(points + pitch_mm, np.array([columns, rows]) * pitch_mm - points).min(axis=1)
        off = points / pitch_mm
        near = np.abs(off - np.rint(off)).min(axis=1) * pitch_mm
        dark = (np.floor(off).sum(axis=1) % 2) == 0
        return np.where(inside < 0.0, 1e3, np.where(dark, -near, near))

    return ink


def draw(
    view: View,
    ink: Ink,
    *,
    dark: float = 40.0,
    bright: float = 200.0,
    blur: float = 0.7,
    slope: tuple[float, float] = (0.0, 0.0),
) -> Floats:
    """Return the image (rows, columns) in grey levels; `slope` is how light grows across the image.

    The lens blurs edges to a normal distribution of `blur` px, then pixels average over their square: in
    this order, as in a camera, since a blur after sampling would leave the aliasing of unblurred edges.
    """
    y, x = np.mgrid[0 : view.rows, 0 : view.columns]
    centres = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    here = view.plane(centres)
    # How many mm a pixel is at most, to tell which pixels an edge runs through.
    mm = 1.5 * np.hypot(*(view.plane(centres + 0.5) - here).T) * np.sqrt(2.0)
    distance = ink(here)
    cover = (distance < 0.0).astype(np.float64)
    edge = np.flatnonzero(np.abs(distance) < (5.0 * blur + 1.0) * mm)
    total = np.zeros(len(edge))
    for dx in (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5:
        for dy in (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5:
            at = centres[edge] + np.array([dx, dy])
            distance = ink(view.plane(at))
            # Distance in px, from that in mm by differences along both axes.
            gx = (ink(view.plane(at + np.array([1e-3, 0.0]))) - distance) / 1e-3
            gy = (ink(view.plane(at + np.array([0.0, 1e-3]))) - distance) / 1e-3
            total += ndtr(-distance / (np.maximum(np.hypot(gx, gy), 1e-9) * blur))
    cover[edge] = total / SAMPLES**2
    cover = cover.reshape(view.rows, view.columns)
    light = 1.0 + slope[0] * (x / view.columns - 0.5) + slope[1] * (y / view.rows - 0.5)
    image = light * (bright + (dark - bright) * cover)
    return np.asarray(image)


@dataclass(frozen=True)
class Draughtsman:
    """What a test draws with."""

    view_of: Callable[..., View] = field(default=view_of)
    dots: Callable[..., Ink] = field(default=dots)
    squares: Callable[..., Ink] = field(default=squares)
    draw: Callable[..., Floats] = field(default=draw)


@pytest.fixture(scope="session")
def draughtsman() -> Draughtsman:
    """Functions that draw boards."""
    return Draughtsman()
