"""Why a board was not seen in an image, and what to do: dark, bright, blurred, cut off, another board."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Singles

_LEAST_CONTRAST = 12.0
"""Of bright over dark, in units of the noise from pixel to pixel: corners fade below."""

_SATURATED = 0.2
"""Part of the pixels at the largest grey level from which on a white ground has grown into the dark parts."""

_WIDEST_EDGE_PX = 8.0
"""From dark to bright of the sharpest edges: in focus it is 2 to 3."""

_SMALLEST = (3, 3)


def why_unseen(image: Singles) -> str:
    """Say what is wrong with a picture in which no board was found; nothing where light and focus are right.

    Parameters
    ----------
    image
        (rows, columns), grey levels.
    """
    import cv2

    dark, bright = np.percentile(image[::2, ::2], (1.0, 99.0))
    contrast = float(bright - dark)
    steps = np.abs(image[:, 2:] - 2.0 * image[:, 1:-1] + image[:, :-2])
    noise = float(np.median(steps)) / (0.6745 * np.sqrt(6.0))
    if contrast < _LEAST_CONTRAST * max(noise, 1e-3) or contrast < 2.0:
        return (
            f"the picture is dark or flat, from {dark:.3g} to {bright:.3g} grey levels with noise of "
            f"{noise:.2g}: light the board better, or expose longer"
        )
    top = image.max()
    full = float(np.mean(image >= top))
    if full > _SATURATED:
        return f"{full:.0%} of the pixels are at the largest grey level, {top:.4g}: expose shorter"
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    slope = np.hypot(cv2.Sobel(smooth, -1, 1, 0, scale=0.125), cv2.Sobel(smooth, -1, 0, 1, scale=0.125))
    width = contrast / max(float(np.percentile(slope, 99.5)), 1e-9)
    if width > _WIDEST_EDGE_PX:
        return f"the sharpest edges are {width:.0f} px wide: focus the lens, or hold the board still"
    return ""


def other_chessboard(image: NDArray[np.uint8], columns: int, rows: int) -> str:
    """Say which chessboard a picture shows instead of the one that was looked for; nothing without one.

    Parameters
    ----------
    image
        (rows, columns), 8 bits.
    columns, rows
        Inner corners of the one that was looked for.
    """
    import cv2

    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(image, _SMALLEST, flags=flags)
    if not found:
        return ""
    down, across = meta.shape[:2]
    told, seen = sorted((columns, rows)), sorted((down, across))
    if told == seen:
        return ""
    grid = np.asarray(corners, dtype=np.float64).reshape(down, across, 2)
    if seen[0] <= told[0] and seen[1] <= told[1] and _cut(grid, image.shape):
        return (
            f"only {across} by {down} of its {columns} by {rows} inner corners are in the picture, which "
            "cuts the board: show it whole"
        )
    return (
        f"the picture shows {across} by {down} inner corners, not {columns} by {rows}: correct the number "
        "of corners, which are one fewer than squares in each direction, or show the board whole"
    )


def _cut(grid: Floats, shape: tuple[int, ...]) -> bool:
    """Say whether the next row or column of corners would lie outside of an image."""
    beyond = np.concatenate(
        [
            2.0 * grid[0] - grid[1],
            2.0 * grid[-1] - grid[-2],
            2.0 * grid[:, 0] - grid[:, 1],
            2.0 * grid[:, -1] - grid[:, -2],
        ]
    )
    inside = (beyond >= 0.0) & (beyond <= np.array([shape[1], shape[0]]) - 1.0)
    return not bool(inside.all())
