"""The fits of returns: of many pixels at once against the plain one, and that against a general solver."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from sms_jobs.metrology.phase.ranging import batched_fit, batched_sums, reference_fit
from sms_jobs.metrology.phase.ranging.batched_fit import fit_one, fit_two, overlap_table
from sms_jobs.metrology.phase.ranging.batched_sums import GROUP, new_room, write_pairs
from sms_jobs.metrology.phase.ranging.reference_fit import AMPLITUDE, OMEGA, SPREAD, VARIANCE
from sms_jobs.metrology.phase.ranging.transform import LANES
from sms_jobs.metrology.phase.ranging.weights import (
    Sums,
    Weights,
    fit_weights,
    leave_out,
    new_weights,
    sums_of,
)

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

NOISE = 20.0  # of each part of z
STRONG = 1000.0


def weights_of(first: int, count: int) -> tuple[Floats, Weights, Sums]:
    """Return t, weights that fall with t, and their sums."""
    t = np.arange(first, first + count, dtype=np.float64)
    precision, transfer = np.where(t == 0.0, 0.5, 1.0), np.exp(-((t / count) ** 2) / 4.0)
    weights = fit_weights(t, precision, transfer, np.ones(count), -(-count // 16) * 16)
    return t, weights, sums_of(weights, first)


def signals_of(
    omega: Floats, amplitude: list[float], t: Floats, weights: Weights, rng: np.random.Generator
) -> NDArray[np.complex128]:
    """Return z, (pixels, densities), of omega (returns, pixels)."""
    turned = np.exp(1j * omega[:, :, None] * t)
    z = np.tensordot(amplitude, turned, axes=1) * weights.transfer[: t.size]
    noise = rng.normal(scale=NOISE, size=(2, *z.shape))
    return np.asarray(z + noise[0] + 1j * np.where(t == 0.0, 0.0, noise[1]))


def fitted_alone(
    z: NDArray[np.complex128], start: Floats, first: int, weights: Weights, sums: Sums
) -> tuple[Floats, float]:
    """Return the estimates of the plain fit of one pixel and the sum of squares that it leaves."""
    padded = weights.transfer.size
    signal = np.zeros((2, padded), np.float32)
    signal[:, : z.size] = z.real, z.imag
    estimates = np.zeros((start.size, reference_fit.COLUMNS))
    estimates[:, OMEGA] = start
    fit = reference_fit.new_fit(start.size, padded)
    for _ in range(2):  # once more from its end, so that nothing is left but rounding
        squares = reference_fit.fit_returns(signal, weights, sums, first, NOISE**2, estimates, fit)
    reference_fit.write_spread(weights, sums, estimates, fit)
    return estimates, squares


def batch_of(z: NDArray[np.complex128]) -> tuple[Single, Single]:
    """Return x and y of a batch."""
    lanes = np.zeros((2, -(-z.shape[1] // GROUP) * GROUP, LANES), np.float32)
    lanes[:, : z.shape[1]] = z.T.real, z.T.imag
    return lanes[0], lanes[1]


@pytest.mark.parametrize(("first", "count", "returns"), [(0, 32, 1), (1, 25, 2), (0, 64, 3), (0, 40, 4)])
def test_the_plain_fit_is_least_squares(
    first: int, count: int, returns: int, rng: np.random.Generator
) -> None:
    t, weights, _ = weights_of(first, count)
    omega = rng.uniform(-3.0, 3.0, (1, 8)) + np.arange(returns)[:, None] * 3.3 * 2.0 * pi / count
    amplitude = [STRONG, 700.0, 500.0, 400.0][:returns]
    lost = (rng.uniform(size=count) < 0.1).astype(np.uint8)
    kept = new_weights(weights.transfer.size)
    leave_out(weights, lost, kept)
    root = np.sqrt(kept.precision[:count])
    for j, z in enumerate(signals_of(omega, amplitude, t, weights, rng)):
        z = np.where(lost, 0.0, z)

        def residual(p: Floats, z: NDArray[np.complex128] = z) -> Floats:
            model = p[returns:] @ np.exp(1j * p[:returns, None] * t) * kept.transfer[:count]
            return np.concatenate([(root * (z - model)).real, (root * (z - model)).imag])

        best = least_squares(residual, [*omega[:, j], *amplitude], x_scale="jac", xtol=1e-14)
        found, squares = fitted_alone(z, omega[:, j] + 0.1 / count, first, kept, sums_of(kept, first))
        sigma = NOISE * np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))[:returns]
        # It stops when a step gains less than 0.01 in chi-square, a tenth of a deviation; what is left is the
        # square of that.
        np.testing.assert_allclose((found[:, OMEGA] - best.x[:returns]) / sigma, 0.0, atol=0.02)
        np.testing.assert_allclose(found[:, AMPLITUDE], best.x[returns:], rtol=1e-4)
        np.testing.assert_allclose(NOISE * np.sqrt(found[:, VARIANCE]), sigma, rtol=1e-3)
        assert squares == pytest.approx(2.0 * best.cost, rel=1e-4)


@pytest.mark.parametrize(("first", "count"), [(0, 64), (1, 25)])
def test_one_return_of_many_pixels_is_fitted_as_alone(
    first: int, count: int, rng: np.random.Generator
) -> None:
    t, weights, sums = weights_of(first, count)
    omega = rng.uniform(-pi, pi, (1, LANES))
    z = signals_of(omega, [STRONG], t, weights, rng)
    x, y = batch_of(z)
    one = np.zeros(batched_sums.SIZE)
    one[:LANES] = omega[0] + 0.5 / count
    fit_one(x, y, count, first, weights, sums, one, new_room(len(x)))
    for j in range(LANES):
        alone, squares = fitted_alone(z[j], omega[:, j], first, weights, sums)
        sigma = NOISE * np.sqrt(alone[0, VARIANCE])
        # The cube of the last step is left, which times s is below 0.1: at 25 densities a thirtieth of sigma.
        assert abs(one[batched_sums.OMEGA + j] - alone[0, OMEGA]) < 0.05 * sigma
        assert one[batched_sums.AMPLITUDE + j] == pytest.approx(alone[0, AMPLITUDE], rel=1e-4)  # sigma: 3e-3
        assert one[batched_sums.SQUARES + j] == pytest.approx(squares, rel=1e-4)
        spread = -2.0 * one[batched_sums.FALL + j] / (alone[0, AMPLITUDE] * sums.spread)
        assert spread == pytest.approx(alone[0, SPREAD], abs=1e-3 / count**2)


@pytest.mark.parametrize("apart", [0.5, 1.0, 2.7, 9.0])
@pytest.mark.parametrize(("first", "count"), [(0, 64), (1, 25)])
def test_two_returns_of_many_pixels_are_fitted_as_alone(
    apart: float, first: int, count: int, rng: np.random.Generator
) -> None:
    t, weights, sums = weights_of(first, count)
    one_bin = 2.0 * pi / count
    omega = rng.uniform(-pi, pi, (1, LANES)) + np.array([[0.0], [apart * one_bin]])
    z = signals_of(omega, [STRONG, 0.5 * STRONG], t, weights, rng)
    x, y = batch_of(z)
    pair, room = np.zeros(batched_fit.PAIR_SIZE), new_room(len(x))
    size = batched_sums.SIZE
    for i, amplitude in enumerate((STRONG, 0.5 * STRONG)):
        pair[i * size : i * size + LANES] = omega[i] + (0.02 - 0.04 * i) * one_bin
        pair[i * size + batched_sums.AMPLITUDE :][:LANES] = amplitude
    table = overlap_table(t, weights.v[0, :count].astype(np.float64))
    every, variance = np.ones(LANES, np.bool_), np.full(LANES, NOISE**2)
    write_pairs(x.reshape(-1), y.reshape(-1), weights.u[0], room.pairs)
    fit_two(x, y, count, first, weights, sums, table, 12, False, every, variance, pair, room)
    for j in range(LANES):
        alone, squares = fitted_alone(z[j], omega[:, j], first, weights, sums)
        for i in range(2):
            o = i * size + j
            sigma = NOISE * np.sqrt(alone[i, VARIANCE])
            # Both stop when a step gains less than 0.01 in chi-square; where returns are close, what is left
            # is more than the square of that.
            assert (
                abs(pair[o + batched_sums.OMEGA] - alone[i, OMEGA]) < (0.1 if apart < 1.0 else 0.02) * sigma
            )
            assert pair[o + batched_sums.AMPLITUDE] == pytest.approx(alone[i, AMPLITUDE], rel=0.01)
            cofactor = pair[batched_fit.VARIANCE + j] / pair[o + batched_sums.AMPLITUDE] ** 2
            assert cofactor == pytest.approx(alone[i, VARIANCE], rel=0.02)
            spread = -2.0 * pair[o + batched_sums.FALL] / (alone[i, AMPLITUDE] * sums.spread)
            assert spread == pytest.approx(alone[i, SPREAD], abs=0.02 / count**2)
        assert pair[batched_sums.SQUARES + j] == pytest.approx(squares, rel=1e-3)
