"""What a page keeps of a field: rounding is bounded, whole numbers and gaps are exact."""

from __future__ import annotations

import base64
import zlib

import numpy as np
import pytest

from sms_jobs.formats.report.packing import LARGEST, Packed, PackedSigma, pack, pack_sigma

SHAPE = (40, 30)


def field(rng: np.random.Generator) -> np.ndarray:
    values = rng.normal(3.0, 2.0, SHAPE).astype(np.float32)
    values[rng.random(SHAPE) < 0.3] = np.nan
    return values


def unpacked(text: str) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)


def numbers(away: np.ndarray, mask: int) -> np.ndarray:
    """Return whole numbers (rows, columns) from how far each is from what its neighbours let expect."""
    found = np.zeros(away.shape, np.int64)
    for row, column in np.ndindex(away.shape):
        left = found[row, column - 1] if column else found[row - 1, 0] if row else 0
        above = found[row - 1, column] if row else left
        between = found[row - 1, column - 1] if row and column else left
        expected = sorted((left, above, left + above - between))[1]
        half, negative = divmod(int(away[row, column]), 2)
        found[row, column] = (expected + (-half - 1 if negative else half)) & mask
    return found


def unpack(packed: Packed, shape: tuple[int, int]) -> np.ndarray:
    """Return what a page shows of packed values, (rows, columns), NaN for none."""
    high, low = unpacked(packed.text).reshape(2, *shape).astype(np.int64)
    number = numbers((high << 8) | low, 0xFFFF)
    return np.where(number > 0, packed.low + (number - 1.0) * packed.step, np.nan)


def unpack_sigma(packed: PackedSigma, shape: tuple[int, int]) -> np.ndarray:
    """Return what a page shows of packed standard deviations, (rows, columns), NaN for none."""
    number = numbers(unpacked(packed.text).reshape(shape), 0xFF)
    return np.where(number > 0, packed.low * np.exp((number - 1.0) * packed.step), np.nan)


def test_a_field_without_deviations_keeps_sixteen_bits(rng: np.random.Generator) -> None:
    values = field(rng)
    packed = pack(values)
    found = unpack(packed, SHAPE)
    assert np.array_equal(np.isnan(found), np.isnan(values))
    assert packed.step == pytest.approx(float(np.nanmax(values) - np.nanmin(values)) / (LARGEST - 1))
    # Half a step, and the rounding of the numbers themselves.
    np.testing.assert_allclose(found, values, rtol=0, atol=0.5 * packed.step * (1 + 1e-6))


def test_rounding_adds_less_than_a_thousandth_to_the_variance(rng: np.random.Generator) -> None:
    values = field(rng)
    sigma = np.full(SHAPE, 0.05, np.float32)
    packed = pack(values, sigma)
    assert packed.step == pytest.approx(0.05 / 12)
    error = unpack(packed, SHAPE) - values
    # A uniform error of one step has the variance step^2 / 12, here 0.00058 of sigma^2; some 800 samples know
    # it to 3 %, of which these are four.
    assert np.nanvar(error) < 0.00058 * 1.13 * 0.05**2


def test_a_grain_is_the_finest_step(rng: np.random.Generator) -> None:
    values = field(rng)
    found = unpack(pack(values, grain=0.25), SHAPE)
    np.testing.assert_allclose(found, values, rtol=0, atol=0.125 * (1 + 1e-6))


def test_whole_numbers_are_exact(rng: np.random.Generator) -> None:
    values = rng.integers(0, 4096, SHAPE).astype(np.float32)
    assert np.array_equal(unpack(pack(values), SHAPE), values)


def test_nothing_stays_nothing_and_a_constant_itself() -> None:
    nothing = np.full(SHAPE, np.nan, np.float32)
    assert np.isnan(unpack(pack(nothing), SHAPE)).all()
    assert np.isnan(unpack_sigma(pack_sigma(nothing), SHAPE)).all()
    constant = np.full(SHAPE, 0.1, np.float32)
    np.testing.assert_array_equal(unpack(pack(constant), SHAPE), constant)
    # One rounding to single precision.
    np.testing.assert_allclose(unpack_sigma(pack_sigma(constant), SHAPE), constant, rtol=2.0**-23)


@pytest.mark.parametrize("decades", [0.1, 1.0, 6.0])
def test_deviations_are_rounded_in_proportion(rng: np.random.Generator, decades: float) -> None:
    sigma = (10.0 ** (-decades * rng.random(SHAPE))).astype(np.float32)
    sigma[0, :3] = (np.nan, 0.0, np.inf)
    packed = pack_sigma(sigma)
    # 8 % a step, or the range in 253 steps where that is coarser.
    assert packed.step <= max(0.08, decades * np.log(10.0) / 253)
    found = unpack_sigma(packed, SHAPE)
    assert np.isnan(found[0, :3]).all()
    np.testing.assert_allclose(found[1:], sigma[1:], rtol=np.expm1(0.5 * packed.step) * (1 + 1e-5))
