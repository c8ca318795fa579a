"""Finds chessboards: which corner is which, and where it is to a fraction of a pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.targets.patterns import BoardPoints, not_found
from sms_jobs.metrology.targets.saddle_fit import fit_saddles
from sms_jobs.metrology.targets.unseen import other_chessboard, why_unseen

_DISC = 0.4  # of the distance to the nearest corner, so that no other corner is in sight
_MOST_DISC_PX = 12.0  # lines are straight and light is a plane in that
_LEAST_DISC_PX = 3.5
_MOST_RESIDUAL_OVER_CONTRAST = 0.5
_LEAST_FITTED = 0.85  # part of the corners: where more are missing, squares of another board may stand in
_CORNER_CONTRAST = 0.5  # of the board's own, of a corner beyond it
_GOES_ON = 0.5  # part of the places beside a board that are corners from which on it is larger
_LEAST_BEYOND = 2  # of those in the image: one may be dirt
_MOST_BEND = 0.35  # change of a step, in steps: perspective makes a tenth, a corner of another row a half
_LARGER = (
    "so many were found, but they are a part of a larger board or in no regular order: correct the number of "
    "corners, which are one fewer than squares in each direction, or show the board whole"
)
_NOTHING_WRONG = "show it whole, flat and with a white border about it"


def _eight_bits(image: Singles) -> NDArray[np.uint8]:
    """Return an image scaled to 8 bits, without its brightest and darkest thousandth."""
    low, high = np.percentile(image[::4, ::4], (0.1, 99.9))
    scaled = (image - low) * (255.0 / max(high - low, 1e-6))
    return np.asarray(np.clip(scaled, 0, 255), dtype=np.uint8)


def _grid(image: NDArray[np.uint8], columns: int, rows: int) -> Floats | None:
    """Return the corners (rows, columns, 2) to about a pixel, not mirrored, or None."""
    import cv2

    size = (columns, rows)
    quick = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(image, size, flags=quick)
    if not found:
        # Slower, and sees through blur, noise and squares that the board's edge cuts.
        thorough = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCornersSB(image, size, flags=thorough)
    if not found:
        return None
    grid = np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2)
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    return grid if right[0] * down[1] - right[1] * down[0] > 0.0 else grid[::-1]


def _ways(grid: Floats) -> tuple[Floats, Floats]:
    """Return the steps (rows, columns, 2) to the next column and the next row."""
    return np.gradient(grid, axis=1), np.gradient(grid, axis=0)


def _fitted(image: Singles, grid: Floats, threads: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return corners, covariances, contrasts and residuals, each (rows, columns, ...)."""
    along, down = _ways(grid)
    nearest = np.minimum(np.hypot(*np.moveaxis(along, -1, 0)), np.hypot(*np.moveaxis(down, -1, 0)))
    radius = np.clip(_DISC * nearest, _LEAST_DISC_PX, _MOST_DISC_PX)
    first, second = (np.arctan2(way[..., 1], way[..., 0]).ravel() for way in (along, down))
    shape = grid.shape[:2]
    corner, covariance, contrast, residual = fit_saddles(
        image, grid.reshape(-1, 2), first, second, radius.ravel(), threads=threads
    )
    return (
        corner.reshape(*shape, 2),
        covariance.reshape(*shape, 2, 2),
        contrast.reshape(shape),
        residual.reshape(shape),
    )


def _is_regular(corner: Floats, contrast: Floats) -> bool:
    """Say whether colours alternate over a grid and its steps change as perspective and lens change them."""
    row, column = np.indices(contrast.shape)
    sign = np.sign(contrast * (-1.0) ** (row + column))[np.isfinite(contrast)]
    if len(np.unique(sign)) > 1:
        return False
    for grid in (corner, np.swapaxes(corner, 0, 1)):
        step = np.diff(grid, axis=0)
        if len(step) > 1:
            bend = np.linalg.norm(np.diff(step, axis=0), axis=-1)
            if np.nanmax(2.0 * bend / np.linalg.norm(step[1:] + step[:-1], axis=-1)) > _MOST_BEND:
                return False
    return True


def _goes_on(image: Singles, grid: Floats, contrast: Floats, threads: int) -> bool:
    """Say whether corners follow beyond one of the four sides of a grid: then it is a part of a larger one.

    Beyond a board's own last corners lies the outer edge of its squares, whose corners are dark on one
    side alone; a corner has the board's contrast, with the sign that the order of squares gives it.
    """
    usual = float(np.nanmedian(np.abs(contrast)))
    for quarter in range(4):
        turned = np.rot90(grid, quarter)
        last = np.stack([turned[0], 2.0 * turned[0] - turned[1]])  # of the board, and what may follow
        inside = ((last[1] > 0.0) & (last[1] < np.array(image.shape[::-1]) - 1.0)).all(axis=1)
        if inside.sum() < _LEAST_BEYOND:
            continue
        _, _, found, residual = _fitted(image, last, threads)
        alternates = -found[1] * found[0] > (_CORNER_CONTRAST * usual) ** 2
        corner = alternates & (residual[1] < _MOST_RESIDUAL_OVER_CONTRAST * np.abs(found[1]))
        if corner[inside].mean() > _GOES_ON:
            return True
    return False


def _first_square_is_bright(contrast: Floats) -> bool:
    """Tell whether the square before the first corner, along both directions, is bright."""
    row, column = np.indices(contrast.shape)
    return bool(np.nanmedian(contrast * (-1.0) ** (row + column)) > 0.0)


def _quarters(grid: Floats, contrast: Floats) -> int:
    """Return by how many quarters of a turn to turn a grid so that its first corner is the board's."""
    rows, columns = grid.shape[:2]
    choices = (0, 1, 2, 3) if rows == columns else (0, 2)
    rights = []
    for quarter in choices:
        turned = np.rot90(grid, quarter)
        way = turned[:, -1].mean(axis=0) - turned[:, 0].mean(axis=0)
        bright = _first_square_is_bright(np.rot90(contrast, quarter) * (-1.0) ** quarter)
        telling = (rows + columns) % 2 == 1
        rights.append((not bright if telling else True, way[0] / np.hypot(*way)))
    return choices[int(max(range(len(choices)), key=lambda k: rights[k]))]


def find_chessboard(
    image: NDArray[np.generic], columns: int, rows: int, pitch_mm: float, *, threads: int = 1
) -> BoardPoints:
    """Find a chessboard, which must be seen whole, and fit a blurred corner to each of its corners.

    It has no marks by which a part could be numbered: parts that are a column apart look alike, in two
    cameras too. A board that goes on beyond the corners that were told is therefore refused.

    The order is never mirrored: columns run to the right and rows downwards as the board is seen from the
    front. When the sum of columns and rows is odd, the square before the first corner is the dark one of
    the two that it may be, whatever the board's turn in the image; otherwise a turned board looks the same,
    and the columns are those that run to the right of the image (of a square board: within 45 degrees).

    Parameters
    ----------
    image
        (rows, columns), grey levels of any type.
    columns, rows
        Number of inner corners along each direction.
    pitch_mm
        Side of a square.
    threads
        Number of threads; never changes a result.

    Returns
    -------
    The corners, or none of them and the reason.
    """
    grey = np.ascontiguousarray(image, dtype=np.float32)
    eight_bits = _eight_bits(grey)
    grid = _grid(eight_bits, columns, rows)
    if grid is None:
        why = why_unseen(grey) or other_chessboard(eight_bits, columns, rows) or _NOTHING_WRONG
        return not_found(f"no chessboard of {columns} by {rows} inner corners was seen as a whole: {why}", {})
    corner, covariance, contrast, residual = _fitted(grey, grid, threads)
    unseen = f"no chessboard of {columns} by {rows} inner corners was seen as a whole"
    if not _is_regular(grid, contrast) or _goes_on(grey, grid, contrast, threads):
        return not_found(f"{unseen}: {_LARGER}", {})
    quarter = _quarters(grid, contrast)
    corner, covariance = np.rot90(corner, quarter), np.rot90(covariance, quarter)
    good = np.rot90(
        np.isfinite(contrast) & (residual < _MOST_RESIDUAL_OVER_CONTRAST * np.abs(contrast)), quarter
    )
    refused = {"no corner": int((~good).sum())} if not good.all() else {}
    if not good.mean() > _LEAST_FITTED:
        return not_found(
            f"{unseen}: only {int(good.sum())} of {good.size} corners could be fitted, {_LEAST_FITTED:.0%} "
            "are needed: keep glare and hands off it, or correct the number of corners",
            refused,
        )
    row, column = np.nonzero(good)
    place = np.stack([column, row], axis=-1).astype(np.int32)
    centre, spread = corner[good], covariance[good]
    return BoardPoints(
        place=place,
        point=np.column_stack([place * float(pitch_mm), np.zeros(len(place))]),
        centre_px=centre,
        covariance_px=spread,
        sigma_px=np.sqrt(0.5 * np.trace(spread, axis1=1, axis2=2)),
        ellipse_px=centre,
        radius_px=np.zeros(len(place)),
        refused=refused,
    )
