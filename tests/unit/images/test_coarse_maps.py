"""Maps that are computed at few pixels."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.images.coarse_maps import MOST_BLOCKS, sample_blocks, spread


@pytest.mark.parametrize("shape", [(40, 50), (512, 512), (300, 700)])
def test_nearly_each_block_has_one_valid_pixel(shape: tuple[int, int], rng: np.random.Generator) -> None:
    valid = rng.random(shape) < 0.3
    samples = sample_blocks(valid)
    assert valid[samples.pixels].all()
    blocks = np.unique(np.stack([samples.rows, samples.columns]) // samples.block_px, axis=1)
    assert blocks.shape[1] == len(samples.rows)
    having = np.unique(np.stack(np.nonzero(valid)) // samples.block_px, axis=1).shape[1]
    # Of 16 pixels that are looked at in a block, all are invalid with the probability 0.7^16, 0.3 %.
    assert 0.98 * having < len(samples.rows) <= having
    assert max(shape) <= MOST_BLOCKS * samples.block_px


def test_a_speck_in_a_large_image_has_a_sample() -> None:
    valid = np.zeros((1500, 2000), bool)
    valid[701, 903] = True
    samples = sample_blocks(valid)
    assert samples.block_px > 16
    assert (samples.rows, samples.columns) == (701, 903)
    assert np.isfinite(spread(samples, np.ones((1, 1)))).sum() == 1


def test_a_slope_is_kept_but_for_half_a_block_at_the_border() -> None:
    y, x = np.mgrid[:256, :256]
    values = np.stack([1.0 + x / 512.0, 2.0 + y / 256.0])
    valid = np.ones((256, 256), bool)
    valid[100:140, 60:200] = False
    samples = sample_blocks(valid)
    found = spread(samples, values[:, samples.rows, samples.columns])
    off = np.abs(found / values - 1.0)
    # Blocks of 4 px, whose samples are up to 2 px beside their middles, and one part in a thousand.
    assert np.nanmax(off) < 2.5 / 512.0 + 1e-3
    assert (np.isnan(found[0]) == ~valid).all()


def test_values_are_kept_to_one_part_in_a_thousand(rng: np.random.Generator) -> None:
    valid = np.ones((8, 8), bool)
    samples = sample_blocks(valid)
    values = rng.lognormal(0.0, 20.0, (1, 64))
    found = spread(samples, values)[0, samples.rows, samples.columns]
    np.testing.assert_allclose(found, values[0], rtol=2.0**-10)


def test_what_is_known_nowhere_is_nan() -> None:
    samples = sample_blocks(np.ones((8, 8), bool))
    assert np.isnan(spread(samples, np.full((3, 64), np.nan))).all()
    nothing = sample_blocks(np.zeros((8, 8), bool))
    assert np.isnan(spread(nothing, np.empty((3, 0)))).all()
