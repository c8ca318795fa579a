"""Speed of matching, displacement and strain; run with `pytest --benchmark-only`, never part of the suite."""

from __future__ import annotations

import time

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from scipy import ndimage

from sms_jobs.metrology.deformation.matching.correlation import MatchSettings, match_points, prepare_images
from sms_jobs.metrology.deformation.matching.grid import GridSettings, match_grid
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings, seed_displacements
from sms_jobs.metrology.deformation.strain.tangent_plane import surface_strain

SIZE = 512


@pytest.fixture(scope="module")
def view() -> tuple[np.ndarray, np.ndarray]:
    """Return a speckle image, and itself stretched by 0.2 %, both with noise."""
    rng = np.random.default_rng(1)
    pattern = ndimage.gaussian_filter(rng.normal(size=(SIZE, SIZE)), 1.8)
    pattern = 2000.0 + 400.0 * pattern / pattern.std()
    row, column = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    deformed = ndimage.map_coordinates(pattern, [row - 0.3, 0.998 * column + 0.2], order=5, mode="mirror")
    return pattern + rng.normal(0.0, 10.0, pattern.shape), deformed + rng.normal(0.0, 10.0, pattern.shape)


@pytest.mark.parametrize("radius", [10, 16])
def test_first_order_matching(
    benchmark: BenchmarkFixture, view: tuple[np.ndarray, np.ndarray], radius: int
) -> None:
    """Points from integer seeds, as after a search; target 20,000 points a CPU-second at radius 16."""
    images = prepare_images(*view, np.ones((SIZE, SIZE), np.int32))
    y, x = (a.ravel() for a in np.mgrid[30:480:5, 30:480:5])
    guess = np.zeros((len(x), 6))
    guess[:, 0], guess[:, 3] = np.rint(0.002 * x), 0.0
    benchmark.pedantic(
        match_points,
        (images, x, y, guess, MatchSettings(radius=radius)),
        rounds=5,
        warmup_rounds=1,
    )
    benchmark.extra_info["points per second"] = len(x) / benchmark.stats["min"]


def test_a_grid_with_its_seeds(benchmark: BenchmarkFixture, view: tuple[np.ndarray, np.ndarray]) -> None:
    """All of a correlate job's matching; seeds are to take a third of it at most."""
    images = prepare_images(*view, np.ones((SIZE, SIZE), np.int32))
    settings = MatchSettings(radius=16), GridSettings(spacing=4), SearchSettings()
    found = benchmark.pedantic(
        match_grid,
        (images, view[1], *settings),
        rounds=5,
        warmup_rounds=1,
    )
    y, x = (a.ravel() for a in np.mgrid[32:SIZE:64, 32:SIZE:64])
    start = time.process_time()
    seed_displacements(images.reference, view[1], images.labels, x, y, SearchSettings())
    benchmark.extra_info["seeding, part of the whole"] = (time.process_time() - start) / benchmark.stats[
        "min"
    ]
    benchmark.extra_info["points per second"] = len(found.x) / benchmark.stats["min"]


def test_strain_of_every_pixel(benchmark: BenchmarkFixture) -> None:
    row, column = np.mgrid[0:SIZE, 0:SIZE]
    xyz = np.stack([0.5 * column, -0.5 * row, 0.1 * column])
    labels, covariance = np.ones((SIZE, SIZE), np.int32), np.ones((6, SIZE, SIZE))
    benchmark.pedantic(
        surface_strain,
        (xyz, 1e-3 * xyz, covariance, labels),
        {"gauge_length_mm": 20.0},
        rounds=3,
        warmup_rounds=1,
    )
    benchmark.extra_info["pixels per second"] = SIZE**2 / benchmark.stats["min"]
