"""Close returns whose amplitudes another orientation tells: errors, sides, and what speaks against them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.ranging.shared_amplitudes import CloseReturns, ToldApart, tell_apart
from sms_jobs.metrology.phase.response import Response

S, ROWS, COLUMNS, Q = 32, 20, 100, 4
PIXELS = ROWS * COLUMNS
T = np.arange(1.0, S + 1.0)
BIN = 2.0 * np.pi / (S + 1)
DAMPING = 60.0**-2
TRANSFER = np.exp(-DAMPING * T**2)
LIGHT = np.array([[800.0], [240.0]])
TOLD_SIGMA = np.full((2, PIXELS), 8.0)
MEAN, NOISE = 2000.0, 8.0  # grey levels
LINEAR = Response(np.ones(1), np.zeros(1), DAMPING, 1.0, 0.0, 1.0)
CAMERA = GreyLevels(full_scale=65535, gain=0.0, read_noise=float(np.hypot(NOISE, 12**-0.5)))
VARIANCE = 2.0 / Q * CAMERA.read_noise**2  # of either part of z


def returns(bins: float) -> Floats:
    """Return the places (2, pixels) of two returns that are so far apart, the first anywhere."""
    first = np.random.default_rng(1).uniform(-2.0, 2.0, PIXELS)
    return np.stack([first, first + bins * BIN])


def recorded(omega: Floats, response: Response = LINEAR) -> NDArray[Any]:
    """Return what a camera sees of two returns, (frames, rows, columns)."""
    steps = 2.0 * np.pi / Q * np.arange(Q)
    frames = MEAN + np.random.default_rng(2).normal(0.0, NOISE, (S, Q, PIXELS))
    strengths = np.array([response.at_density(t) for t in T])
    for places, light in zip(omega, LIGHT[:, 0], strict=True):
        phase = np.multiply.outer(T, places)[:, None] + steps[:, None]
        for n, strength in enumerate(strengths.T, 1):
            frames += light * strength[:, None, None] * np.cos(n * phase)
    return np.rint(frames).astype(np.uint16).reshape(S * Q, ROWS, COLUMNS)


def told() -> Floats:
    """Return the amplitudes as another orientation tells them."""
    return np.asarray(LIGHT + TOLD_SIGMA * np.random.default_rng(3).normal(size=(2, PIXELS)))


def fit(
    frames: NDArray[Any], found: Floats, amplitudes: Floats, response: Response | None = None
) -> ToldApart:
    """Fit all pixels."""
    every: Mask = np.ones((ROWS, COLUMNS), np.bool_)
    close = CloseReturns(every, found, amplitudes, TOLD_SIGMA)
    return tell_apart(frames, tuple(T), Q, CAMERA, TRANSFER, close, response=response)


def both(omega: Floats) -> Floats:
    """Return what is found where both returns are."""
    return np.concatenate([omega, np.broadcast_to(LIGHT, (2, PIXELS))])


def error_in_sigmas(result: ToldApart, omega: Floats) -> float:
    """Return the rms of the errors in units of what is stated."""
    return float(np.sqrt(np.mean(((result.omega - omega) / result.omega_sigma) ** 2)))


def fitted(bins: float) -> tuple[Floats, ToldApart]:
    """Return errors (2, pixels) of two returns of which one was found, in rad, and the fit."""
    omega = returns(bins)
    middle = np.average(omega, axis=0, weights=LIGHT[:, 0])
    nothing = np.full(PIXELS, np.nan)
    found = np.stack([middle, nothing, np.full(PIXELS, LIGHT.sum()), nothing])
    result = fit(recorded(omega), found, told())
    return result.omega - omega, result


def bounds(bins: float, amplitude_sigma: float) -> Floats:
    """Return the Cramer-Rao bounds (2,) of omega where amplitudes were observed with a deviation."""
    turns = TRANSFER * np.exp(1j * np.outer([0.0, bins * BIN], T))
    columns = np.concatenate([LIGHT * 1j * T * turns, turns])
    fisher = np.real(columns @ columns.conj().T) / VARIANCE
    fisher[[2, 3], [2, 3]] += 1.0 / amplitude_sigma**2
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(fisher)))[:2])


@pytest.mark.parametrize("bins", [0.3, 0.5, -0.5, 1.0])
def test_errors_are_the_bound_of_known_amplitudes(bins: float) -> None:
    """The rms of 2000 normal numbers is within 8 % of their deviation, at five deviations of its own."""
    error, result = fitted(bins)
    assert not result.ambiguous.any()
    assert not result.against.any()
    rms = np.sqrt(np.mean(error**2, axis=1))
    assert rms == pytest.approx(bounds(bins, 8.0), rel=0.08)
    assert error_in_sigmas(result, returns(bins)) == pytest.approx(1.0, abs=0.08)


def test_amplitudes_are_worth_a_factor_where_returns_are_close() -> None:
    """Without them the bound of the stronger at 0.3 bins is more than twice what is reached with them."""
    error, _ = fitted(0.3)
    assert bounds(0.3, 1e9)[0] > 2.0 * np.sqrt(np.mean(error[0] ** 2))


def test_sides_that_cannot_be_told_are_named() -> None:
    """At a twelfth of a bin half the fits would be on the wrong side; whatever is not named is right."""
    error, result = fitted(0.08)
    assert result.ambiguous.mean() > 0.9
    told_apart = ~result.ambiguous
    assert (np.abs(error[:, told_apart]) < 6.0 * result.omega_sigma[:, told_apart]).all()


def test_a_return_of_its_own_amplitudes_speaks_against_others() -> None:
    """Amplitudes that are off by a third of the weaker are noticed where the signal tells them."""
    omega = returns(1.2)
    wrong = np.broadcast_to(LIGHT + np.array([[160.0], [-160.0]]), (2, PIXELS))
    assert fit(recorded(omega), both(omega), wrong).against.all()


def test_harmonics_are_a_part_of_each_return() -> None:
    """A third harmonic, which four steps take for fringes, moves nothing once it is in the model."""
    omega, harmonics = returns(0.4), np.array([1.0, 0.0, 0.1])
    response = Response(harmonics, np.zeros(3), DAMPING, 1.0, 0.0, 1.0)
    frames = recorded(omega, response)
    z = [error_in_sigmas(fit(frames, both(omega), told(), known), omega) for known in (response, None)]
    assert z[0] == pytest.approx(1.0, abs=0.08)
    assert z[1] > 1.5


def test_saturated_densities_weigh_nothing() -> None:
    """Frames at full scale are no cosine: with them errors would be hundreds of deviations."""
    omega = returns(0.4)
    frames = recorded(omega)
    frames[8 * Q + 1, 3:6] = frames[20 * Q, :, 40:] = CAMERA.full_scale
    assert error_in_sigmas(fit(frames, both(omega), told()), omega) == pytest.approx(1.0, abs=0.08)


def test_some_pixels_are_fitted_as_all_are_on_any_number_of_threads() -> None:
    omega = returns(0.4)
    where = np.random.default_rng(4).random((ROWS, COLUMNS)) < 0.3
    where[5] = False
    frames, chosen = recorded(omega), where.ravel()
    every = fit(frames, both(omega), told())
    close = CloseReturns(where, both(omega)[:, chosen], told()[:, chosen], TOLD_SIGMA[:, chosen])
    some = tell_apart(frames, tuple(T), Q, CAMERA, TRANSFER, close, threads=2)
    assert np.array_equal(some.omega, every.omega[:, chosen])
    assert np.array_equal(some.omega_sigma, every.omega_sigma[:, chosen])


def test_what_tells_no_place_is_spoken_against() -> None:
    omega = returns(0.4)
    frames = recorded(omega)
    frames[:, 0] = CAMERA.full_scale
    result = fit(frames, both(omega), told())
    assert result.against[:COLUMNS].all()
    assert not result.against[COLUMNS:].any()


def test_a_pixel_is_fitted_alike_whichever_others_are() -> None:
    omega = returns(0.5)
    frames, amplitudes, found = recorded(omega), told(), both(omega)
    camera = replace(CAMERA, gain=0.05)  # whose noise differs from pixel to pixel

    def some(where: Mask, threads: int) -> ToldApart:
        chosen = where.ravel()
        close = CloseReturns(where, found[:, chosen], amplitudes[:, chosen], TOLD_SIGMA[:, chosen])
        return tell_apart(frames, tuple(T), Q, camera, TRANSFER, close, threads=threads)

    whole = some(np.ones((ROWS, COLUMNS), np.bool_), 1)
    # Rows of as many pixels as a block of them has, which is 16, and one more or less; not side by side.
    few = np.zeros((ROWS, COLUMNS), np.bool_)
    for row, count in enumerate((0, 1, 15, 16, 17, 31, 32, 33)):
        few[row, np.random.default_rng(row).permutation(COLUMNS)[:count]] = True
    few[10:, ::3] = True
    part = some(few, 2)
    for name in ("omega", "omega_sigma", "amplitude", "ambiguous", "against"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[..., few.ravel()])
