"""Displacement on published images of two cameras by several programs with one calibration, point by point.

GT4 as in `published`: nobody knows the truth, but programs that are right differ by little.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from itertools import combinations

import numpy as np
from PIL import Image

from sms_jobs.bench.two_cameras.peers import Given, Image8, Outcome
from sms_jobs.bench.two_cameras.published import FOLDER, STATES
from sms_jobs.formats.interchange.calibration_files import read_calibration
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.images.smoothing import smooth
from sms_jobs.metrology.images.texture_extent import textured_pixels
from sms_jobs.records.supplements import Supplement

GT4_SUBSET_PX, GT4_SPACING_PX = 25, 16
_SEARCH_PX = 16
_DISPARITY_PX = (-38.0, -41.0)
_NOISE = 2.0  # grey levels; twice what the first two states differ by where it is bright
_MARGIN_PX = 5  # of the specimen's rim, as in our own outline


def given_gt4() -> Given:
    """Return what all programs are given of GT4: images, calibration, and where the specimen is."""
    images = tuple((_image(state, 0), _image(state, 1)) for state in (0, *STATES))
    said = Supplement(rig="gt4", valid_from=datetime(2010, 1, 1, tzinfo=UTC))
    calibration = read_calibration([FOLDER / "cal.xml"], said).calibration
    levels = np.asarray(smooth(images[0][0].astype(np.float64), 0.6))
    specimen = textured_pixels(levels, _NOISE**2, GT4_SUBSET_PX // 2, _MARGIN_PX)
    return Given(
        images, calibration, specimen, _SEARCH_PX, GT4_SUBSET_PX, GT4_SPACING_PX, _DISPARITY_PX, _NOISE
    )


def _image(state: int, camera: int) -> Image8:
    with Image.open(FOLDER / "images" / f"GT4-{state:04d}_{camera}.tif") as image:
        return np.asarray(image.convert("L"), dtype=np.uint8)


def differences_um(here: Floats, others: Mapping[str, Outcome]) -> dict[tuple[str, str], Floats]:
    """Return by how much the displacements of each two programs differ, (states, 3, n) in um.

    `here` (states, 3, rows, columns) are those of every pixel in mm in C1's frame, looked up at the points of
    the others; two others are compared at the points of the second, with the first's interpolated between
    the points of its grid. NaN where either has none.
    """
    found = {}
    for name, other in others.items():
        x, y = np.rint(other.pixels).astype(np.int64)
        found["here", name] = 1e3 * (here[:, :, y, x] - other.displacement)
    for one, second in combinations(others, 2):
        apart = at_points(others[one], others[second].pixels) - others[second].displacement
        found[one, second] = 1e3 * apart
    return found


def at_points(found: Outcome, pixels: Floats) -> Floats:
    """Return the displacement (states, 3, n) at pixels (2, n), linear between a square grid's four points."""
    x, y = np.rint(found.pixels).astype(np.int64)
    left, top = int(x.min()), int(y.min())
    column, row = (x - left) // found.spacing_px, (y - top) // found.spacing_px
    states = len(found.displacement)
    grid = np.full((states, 3, int(row.max()) + 2, int(column.max()) + 2), np.nan)
    grid[:, :, row, column] = found.displacement
    at_x, at_y = (pixels[0] - left) / found.spacing_px, (pixels[1] - top) / found.spacing_px
    inside = (at_x >= 0) & (at_y >= 0) & (at_x < grid.shape[3] - 1) & (at_y < grid.shape[2] - 1)
    i, j = (np.where(inside, at, 0.0).astype(np.int64) for at in (at_x, at_y))
    s, t = np.where(inside, at_x - i, np.nan), np.where(inside, at_y - j, np.nan)
    value = np.zeros((states, 3, pixels.shape[1]))
    for dx, across in ((0, 1.0 - s), (1, s)):
        for dy, down in ((0, 1.0 - t), (1, t)):
            weight = across * down
            # A neighbour that weighs nothing may be missing.
            value += np.where(weight == 0.0, 0.0, weight * grid[:, :, j + dy, i + dx])
    return value
