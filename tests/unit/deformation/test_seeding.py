"""Seeds are the peaks of a correlation that sees one region only."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.metrology.deformation.matching.seeding import (
    SearchSettings,
    block_means,
    masked_correlation,
    repeats_itself,
    seed_displacements,
    seed_warps,
)


@pytest.mark.parametrize("missing", [0.1, 0.0])
@pytest.mark.parametrize(("gaps", "rows", "columns"), [(0.3, 9, 11), (0.0, 9, 11), (0.0, 8, 14)])
def test_masked_correlation_is_the_slow_reference(
    rng: np.random.Generator, missing: float, gaps: float, rows: int, columns: int
) -> None:
    template, image = rng.uniform(0.0, 4095.0, (rows, columns)), rng.uniform(0.0, 4095.0, (20, 24))
    own, searched = rng.random((rows, columns)) >= gaps, rng.random((20, 24)) >= missing
    found = masked_correlation(template, own, image, searched)
    assert found.shape == (21 - rows, 25 - columns)
    for j in range(21 - rows):
        for i in range(25 - columns):
            both = own & searched[j : j + rows, i : i + columns]
            expected = np.corrcoef(template[both], image[j : j + rows, i : i + columns][both])[0, 1]
            # Single precision: sums of 100 products to 10^-7 each, means removed.
            assert abs(found[j, i] - expected) < 1e-5


@pytest.mark.parametrize("factor", [2, 4, 8])
def test_means_of_blocks_leave_out_what_makes_none(factor: int, rng: np.random.Generator) -> None:
    image = rng.normal(100.0, 30.0, (53, 75))
    found = block_means(image, factor)
    assert found.shape == (53 // factor, 75 // factor)
    for row, column in np.ndindex(found.shape):
        block = image[factor * row : factor * (row + 1), factor * column : factor * (column + 1)]
        assert found[row, column] == pytest.approx(block.mean(), rel=1e-12)


def test_an_image_smaller_than_a_block_has_none_and_is_searched_finely(rng: np.random.Generator) -> None:
    image = rng.normal(size=(7, 60))
    assert block_means(image, 8).shape == (0, 7)
    wide = SearchSettings(400, 400, template_radius=20)
    at = np.array([30]), np.array([3])
    _, _, score = seed_displacements(image, image, np.ones(image.shape, np.int32), *at, wide)
    assert score[0] == pytest.approx(1.0, abs=1e-5)  # in single precision


def test_a_lag_with_little_overlap_is_no_match(rng: np.random.Generator) -> None:
    template, image = rng.uniform(size=(8, 8)), rng.uniform(size=(20, 20))
    searched = np.zeros((20, 20), bool)
    searched[:6] = True
    found = masked_correlation(template, np.ones((8, 8), bool), image, searched)
    assert (found[3:] == -1.0).all()
    assert (found[:3] > -1.0).all()


def test_flat_images_give_no_match() -> None:
    flat = np.full((8, 8), 700.0)
    found = masked_correlation(flat, np.ones((8, 8), bool), np.full((12, 12), 700.0), np.ones((12, 12), bool))
    assert (found == -1.0).all()


def test_regions_that_part_by_tens_of_pixels_are_followed(rng: np.random.Generator) -> None:
    wide = rng.uniform(0.0, 1000.0, (200, 260))
    labels = np.zeros((120, 160), np.int32)
    labels[:60], labels[60:] = 1, 2
    reference = wide[40:160, 50:210]
    deformed = rng.uniform(0.0, 1000.0, (120, 160))
    # The upper half goes 31 px to the right and 7 px up, the lower one 22 px to the left and 3 px down.
    deformed[: 60 - 7, 31:] = reference[7:60, : 160 - 31]
    deformed[63:, : 160 - 22] = reference[60:117, 22:]
    x, y = np.array([60, 80]), np.array([40, 80])
    u, v, score = seed_displacements(reference, deformed, labels, x, y, SearchSettings(40, 20), threads=2)
    np.testing.assert_array_equal(u, [31, -22])
    np.testing.assert_array_equal(v, [-7, 3])
    # Exact copies, but for template pixels whose counterpart was overwritten or left the image: none here.
    assert (score > 0.999).all()


@pytest.mark.parametrize("blob_px", [1.0, 2.5])
def test_a_wide_search_goes_from_coarse_to_fine_and_finds_the_same(
    rng: np.random.Generator, blob_px: float
) -> None:
    wide = 1000.0 * ndimage.gaussian_filter(rng.normal(size=(420, 620)), blob_px)
    reference = wide[100:320, 200:420]
    labels = np.ones((220, 220), np.int32)
    labels[:, 110:] = 2
    # The left half goes 87 px right and 61 px down, the right one 96 px left and 40 px up.
    deformed = 1000.0 * ndimage.gaussian_filter(rng.normal(size=(220, 220)), blob_px)
    deformed[61:, 87:197] = reference[:159, :110]
    deformed[:60, 14:124] = reference[40:100, 110:]
    x, y = np.array([40, 70, 150]), np.array([60, 100, 70])
    found = seed_displacements(reference, deformed, labels, x, y, SearchSettings(120, 90), threads=2)
    np.testing.assert_array_equal(found[0], [87, 87, -96])
    np.testing.assert_array_equal(found[1], [61, 61, -40])
    # Exact copies, but for pixels of the left half that the right one has covered.
    assert (found[2] > 0.7).all()
    # A range that is searched at once finds the same.
    once = seed_displacements(reference, deformed, labels, x[2:], y[2:], SearchSettings(96, 40))
    assert once[0][0] == -96
    assert once[1][0] == -40


def test_a_region_too_small_for_coarse_levels_is_searched_finely(rng: np.random.Generator) -> None:
    reference = ndimage.gaussian_filter(rng.normal(size=(200, 300)), 1.0)
    labels = np.zeros((200, 300), np.int32)
    labels[90:106, 40:56] = 3
    deformed = ndimage.gaussian_filter(rng.normal(size=(200, 300)), 1.0)
    deformed[50:66, 150:166] = reference[90:106, 40:56]
    u, v, score = seed_displacements(
        reference, deformed, labels, np.array([48]), np.array([98]), SearchSettings(130, 60)
    )
    assert (u[0], v[0]) == (110, -40)
    assert score[0] > 0.999


@pytest.mark.parametrize("degrees", [-50.0, 11.0, 38.0])
def test_a_rotation_is_found_where_it_is_looked_for(speckle, degrees: float) -> None:
    size, middle = 96, 47.5
    pattern, angle = speckle.random(31, size), np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)

    def source(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        i, j = x - middle, y - middle
        return middle + c * i + s * j, middle - s * i + c * j

    reference, deformed = pattern.image(size), pattern.image(size, source)
    labels = np.ones((size, size), np.int32)
    x, y = np.array([40, 60, 48]), np.array([40, 50, 62])
    i, j = x - middle, y - middle
    truth = np.stack([c * i - s * j - i, s * i + c * j - j], axis=1)
    looking = SearchSettings(30, 30, range_rotation=0.9)
    warp, score = seed_warps(reference, deformed, labels, x, y, looking)
    # To a pixel, as shifts are, and to half of the 15 degrees between the rotations that are tried, unless a
    # shift alone fits well enough.
    assert np.abs(warp[:, [0, 3]] - truth).max() < 1.5
    found = np.arctan2(warp[:, 4], 1.0 + warp[:, 1])
    assert np.abs(found - angle).max() < np.radians(7.6 if abs(degrees) > 15.0 else 11.1)
    assert (score > 0.5).all()
    without, score = seed_warps(reference, deformed, labels, x, y, SearchSettings(30, 30))
    if abs(degrees) < 15.0:
        # A small template bears as much.
        assert np.abs(without[:, [0, 3]] - truth).max() < 1.5
    else:
        assert (score < 0.65).all()


def test_small_templates_are_for_what_has_no_good_match(rng: np.random.Generator) -> None:
    image = ndimage.gaussian_filter(rng.normal(size=(96, 96)), 1.5)
    labels = np.ones((96, 96), np.int32)
    x, y = np.array([40, 50]), np.array([45, 55])
    settings = SearchSettings(8, 8, range_rotation=0.6)
    u, v, score = seed_displacements(image, np.roll(image, 3, axis=1), labels, x, y, settings)
    warp, same = seed_warps(image, np.roll(image, 3, axis=1), labels, x, y, settings)
    np.testing.assert_array_equal(same, score)
    np.testing.assert_array_equal(warp, np.stack([u, 0 * u, 0 * u, v, 0 * u, 0 * u], axis=1))


def test_a_grid_is_found_again_and_speckle_is_not(rng: np.random.Generator) -> None:
    size, period = 200, 16.0
    y, x = np.mgrid[0:size, 0:size].astype(np.float64)
    grid = 1600.0 + 400.0 * (np.cos(2 * np.pi * x / period) + np.cos(2 * np.pi * y / period))
    speckled = 1600.0 + 8000.0 * ndimage.gaussian_filter(rng.normal(size=grid.shape), 2.0)
    image = np.where(x < size / 2, grid, speckled) + rng.normal(0.0, 20.0, grid.shape)
    labels = np.where(x < size / 2, 1, 2).astype(np.int32)
    at = np.array([50, 150]), np.array([100, 100])
    np.testing.assert_array_equal(repeats_itself(image, labels, *at, SearchSettings()), [True, False])
    # Nothing within less than a period is like a grid's own place.
    near = SearchSettings(range_x=7, range_y=7)
    np.testing.assert_array_equal(repeats_itself(image, labels, *at, near), [False, False])
