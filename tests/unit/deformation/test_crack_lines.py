"""Lines along which a displacement jumps are found, and nothing else is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import ndimage
from support.matched import spread_over_pixels

from sms_jobs.metrology.deformation.cracks.lines import crack_lines
from sms_jobs.metrology.deformation.matching.correlation import Noise, PreparedImages, prepare_images
from sms_jobs.metrology.deformation.matching.verification import verify_displacement
from sms_jobs.metrology.images.smoothing import noise_after_smoothing, smooth

SIZE, RADIUS, SMOOTHING, NOISE = 220, 10, 0.6, 12.0
ROW, COLUMN = np.mgrid[0:SIZE, 0:SIZE].astype(float)
STRAIGHT = COLUMN - 105.0
SLANTING = 0.8 * (COLUMN - 110.0) + 0.6 * (ROW - 110.0)
CURVED = np.hypot(COLUMN + 290.0, ROW - 110.0) - 400.0


def images(speckle: object, parts: list[tuple[np.ndarray, Any]], sigma: float = NOISE) -> PreparedImages:
    """Return noisy speckle of which the chosen parts (rows, columns) have moved by (2, rows, columns)."""
    pattern, rng = speckle.random(3, SIZE), np.random.default_rng(4)  # type: ignore[attr-defined]
    deformed = np.zeros((SIZE, SIZE))
    for chosen, (u, v) in parts:
        moved = pattern.image(SIZE, lambda x, y, u=u, v=v: (x - u, y - v))
        deformed[chosen] = moved[chosen]
    both = [
        smooth(one + rng.normal(0.0, sigma, one.shape), SMOOTHING) for one in (pattern.image(SIZE), deformed)
    ]
    factor = noise_after_smoothing(both[0], np.ones((SIZE, SIZE), bool), SMOOTHING)
    noise = Noise(sigma**2 * factor, 0.0)
    return prepare_images(*both, np.ones((SIZE, SIZE), np.int32), (noise, noise))


def lines(images: PreparedImages) -> np.ndarray:
    """Return what is found where subsets have measured the displacement."""
    displacement, variance = spread_over_pixels(images, RADIUS)
    verified = verify_displacement(images, displacement, RADIUS, 1, SMOOTHING)
    return crack_lines(images, displacement, variance, verified, images.labels, RADIUS)


def cracked(speckle: object, across: np.ndarray, slip: tuple[float, float]) -> np.ndarray:
    other = across > 0
    moved = ndimage.shift(other.astype(float), slip[::-1], order=1, mode="nearest") > 0.5
    return lines(images(speckle, [(~other, (0.0, 0.0)), (moved, slip)]))


@pytest.mark.parametrize("across", [STRAIGHT, SLANTING, CURVED], ids=["straight", "slanting", "curved"])
@pytest.mark.parametrize("slip", [(0.0, 0.5), (0.0, 1.0), (3.0, 0.0)])
def test_a_crack_is_found_from_edge_to_edge(
    speckle: object, across: np.ndarray, slip: tuple[float, float]
) -> None:
    found = cracked(speckle, across, slip)
    # It parts the image: no way over pixels that are not its own leads from one side to the other.
    pieces, number = ndimage.label(~found)
    large = [k for k in range(1, number + 1) if np.count_nonzero(pieces == k) > 0.1 * SIZE**2]
    assert len(large) == 2
    assert np.abs(across[found]).mean() < 3.0
    # What could not be followed is bridged straight, over a third of the image at most.
    assert np.abs(across[found]).max() < 2.0 * RADIUS


def test_a_crack_is_found_where_it_is_in_a_specimen_that_fills_part_of_the_image(speckle: object) -> None:
    other = STRAIGHT > 0
    pair = images(speckle, [(~other, (0.0, 0.0)), (other, (0.0, 1.0))])
    specimen = (ROW >= 70) & (ROW < 210) & (COLUMN >= 35) & (COLUMN < 175)
    found = lines(replace(pair, labels=specimen.astype(np.int32)))
    assert specimen[found].all()
    assert found[70:210].any(axis=1).all()
    assert np.abs(STRAIGHT[found]).mean() < 3.0


@pytest.mark.parametrize("period", [25.0, 40.0, 80.0])
def test_bending_is_no_crack(speckle: object, period: float) -> None:
    everywhere = np.ones((SIZE, SIZE), bool)
    x = COLUMN.copy()
    for _ in range(30):
        x = COLUMN - 0.5 * np.sin(2.0 * np.pi * x / period)
    pair = images(speckle, [(everywhere, (COLUMN - x, 0.0 * ROW))])
    assert not lines(pair).any()


def test_a_band_that_stretches_is_no_crack(speckle: object) -> None:
    """Strain that is concentrated over twice a subset's width leads steadily from one side to the other."""
    profile: Callable[[np.ndarray], np.ndarray] = lambda x: np.clip((x - 90.0) / 40.0, 0.0, 1.0)  # noqa: E731
    x = COLUMN.copy()
    for _ in range(30):
        x = COLUMN - profile(x)
    pair = images(speckle, [(np.ones((SIZE, SIZE), bool), (COLUMN - x, 0.0 * ROW))])
    assert not lines(pair).any()


@pytest.mark.parametrize("bent", [0.0, 1e-4, 2e-4, 4e-4])
def test_a_fold_is_no_crack(speckle: object, bent: float) -> None:
    """Straight lines through the sides of a fold do not meet where the sheet is bent beside it."""

    def moved(x: np.ndarray) -> np.ndarray:
        way = np.minimum(np.maximum(-x, 0.0), 60.0)
        return bent * way * (2.0 * np.maximum(-x, 0.0) - way) - 0.02 * np.maximum(-x, 0.0)

    undeformed = STRAIGHT.copy()
    for _ in range(30):
        undeformed = STRAIGHT - moved(undeformed)
    everywhere, noise = np.ones((SIZE, SIZE), bool), 4.0
    pair = images(speckle, [(everywhere, (STRAIGHT - undeformed, np.zeros_like(ROW)))], noise)
    exact = np.stack([moved(STRAIGHT), np.zeros_like(ROW)])
    # What a subset makes of a fold: it is rounded.
    told = ndimage.gaussian_filter(exact, (0.0, 0.5 * RADIUS, 0.5 * RADIUS))
    verified = verify_displacement(pair, told, RADIUS, 1, SMOOTHING)
    assert not crack_lines(pair, told, np.full_like(told, 1e-6), verified, pair.labels, RADIUS).any()


def test_where_nothing_has_jumped_there_is_nothing(speckle: object) -> None:
    everywhere = np.ones((SIZE, SIZE), bool)
    pair = images(speckle, [(everywhere, (0.0, 0.0))])
    assert not lines(pair).any()
