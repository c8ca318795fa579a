"""Our matches of published images of two cameras beside those that another program found in them.

GT4 is a steel specimen in tension, with the matches of DICe. The images are no part of
this project: they are looked for beside the checkout.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

import sms_jobs
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    MatchSettings,
    Noise,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings, seed_warps
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.images.smoothing import smooth

FOLDER = Path(sms_jobs.__file__).parents[2] / "shared" / "data" / "stereo" / "gt4"
STATES = range(1, 6)
"""Those that have moved; nothing has in the first, 0."""

_RADIUS = 12  # DICe's subsets of 25 px
_NOISE = Noise(4.0, 0.0)
_SMOOTHING_PX = 0.6
_CROSS, _MOVED = ("CROSS_CORR_Q", "CROSS_CORR_R"), ("DISPLACEMENT_X", "DISPLACEMENT_Y")


def published() -> bool:
    """Return whether images and matches of GT4 lie beside the checkout."""
    return (FOLDER / "gold").is_dir() and (FOLDER / "images").is_dir()


def between_cameras(order: ShapeOrder) -> Floats:
    """Return by how many px, (n,), our matches between the cameras at rest differ from DICe's."""
    return _differences(0, 1, _CROSS, order, SearchSettings(110, 110))


def in_time(state: int, order: ShapeOrder) -> Floats:
    """Return by how many px, (n,), our matches of a state with the first image differ from DICe's."""
    return _differences(state, 0, _MOVED, order, SearchSettings(10, 10))


def _texture(state: int, camera: int) -> Floats:
    with Image.open(FOLDER / "images" / f"GT4-{state:04d}_{camera}.tif") as image:
        return np.asarray(smooth(np.asarray(image.convert("L"), dtype=np.float64), _SMOOTHING_PX))


def _differences(
    state: int, camera: int, names: tuple[str, str], order: ShapeOrder, search: SearchSettings
) -> Floats:
    first, other = _texture(0, 0), _texture(state, camera)
    theirs = np.genfromtxt(FOLDER / "gold" / f"DICe_solution_{state}.txt", delimiter=",", names=True)
    x, y = (theirs[f"COORDINATE_{axis}"].astype(np.int64) for axis in "XY")
    labels = np.ones(first.shape, np.int32)
    guess, _ = seed_warps(first, other, labels, x, y, search)
    images = prepare_images(first, other, labels, (_NOISE, _NOISE))
    found = match_points(images, x, y, guess, MatchSettings(_RADIUS, shape_order=order))
    apart = found.warp[:, [0, 3]] - np.stack([theirs[name] for name in names], axis=1)
    return np.where(found.ending == CONVERGED, np.hypot(*apart.T), np.nan)
