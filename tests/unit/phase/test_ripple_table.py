"""The table of ripples: the same as iterating, and true of frames that a response has distorted."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import MeasurementFailed
from sms_jobs.metrology.phase.response import Response, corrected_gradient, gradient_ripple
from sms_jobs.metrology.phase.ripple_table import ripple_table
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap

DENSITIES = (32, 31, 30, 28, 24, 16)


def response_of(*harmonics: float, damping: float = 0.0) -> Response:
    values = np.array((1.0, *harmonics))
    return Response(values, np.zeros(len(values)), damping, 1.0, 0.0, 1.0)


GAMMA = response_of(0.0909, -0.0148, 0.0047, -0.002, 0.001, damping=1e-4)


def unwrapped(response: Response, omega: NDArray[np.float64], steps: int) -> PhaseGradient:
    """Return what unwrapping finds in frames of a response without noise."""
    frames = [
        30_000.0
        + sum(
            20_000.0 * a * np.cos(n * (omega * t + 2.0 * pi * k / steps))
            for n, a in enumerate(response.at_density(t), 1)
        )
        for t in DENSITIES
        for k in range(steps)
    ]
    stack = np.rint(np.stack(frames)[:, None]).astype(np.uint16)
    return unwrap(stack, DENSITIES, steps, full_scale=65535, gain=0.0, read_noise=1.0)


@pytest.mark.parametrize("steps", [3, 4, 5])
def test_the_table_reads_as_the_iteration_does(rng: np.random.Generator, steps: int) -> None:
    omega = rng.uniform(-pi, pi, 2000)
    table = ripple_table(GAMMA, DENSITIES, steps)
    wanted = corrected_gradient(GAMMA, omega, DENSITIES, steps)
    ripple = np.abs(gradient_ripple(GAMMA, table.true, DENSITIES, steps)).max()
    # Linear interpolation between 32 entries a period: 0.5 % of the ripple where it is finest, and twelve
    # rounds of the iteration leave less.
    np.testing.assert_allclose(table.corrected(omega), wanted, atol=0.005 * ripple + 1e-9)
    assert np.isnan(table.corrected(np.array([np.nan]))).all()


@pytest.mark.parametrize("steps", [3, 4])
def test_frames_of_a_response_are_corrected_and_their_phase_error_is_expected(steps: int) -> None:
    omega = np.linspace(-3.0, 3.0, 1500)
    found = unwrapped(GAMMA, omega, steps)
    table = ripple_table(GAMMA, DENSITIES, steps)
    left = table.corrected(found.omega[0]) - omega
    # One hundredth of the ripple, of second order in the harmonics; rounding gives 1e-7 rad.
    assert np.abs(left).max() < 0.02 * np.abs(found.omega[0] - omega).max() + 1e-6
    expected = table.expected_error(found.omega[0])
    # `unwrap` divides by one density fewer, and its error is of the phase alone, never more than the whole.
    assert (found.phase_error[0] * np.sqrt(5.0 / 6.0) <= 1.05 * expected + 1e-4).all()
    rms = np.sqrt(np.mean(np.square(found.phase_error)) / np.mean(np.square(expected)))
    assert 0.5 < rms < 1.2  # half the power lies along the phase


def test_noise_is_scaled_by_the_slope(rng: np.random.Generator) -> None:
    table = ripple_table(GAMMA, DENSITIES, 3)
    sigma = 1e-5
    # Where the ripple is steepest, and where all densities agree.
    for true in (0.0, float(table.true[np.argmin(table.slope)]), float(table.true[np.argmax(table.slope)])):
        at = np.interp(true, table.true, table.measured)
        scatter = np.std(table.corrected(at + sigma * rng.normal(size=20_000)))
        stated = table.corrected_sigma(np.array([at]), np.array([sigma], np.float32))[0]
        # 20,000 draws scatter by 0.5 %; the slope changes by some per cent within 1e-5 rad.
        assert scatter == pytest.approx(stated, rel=0.03)
    assert table.slope.max() > 1.02
    assert table.slope.min() < 0.9


def test_a_response_that_is_too_far_from_linear_is_refused() -> None:
    with pytest.raises(MeasurementFailed, match="look alike"):
        ripple_table(response_of(0.6, 0.3), DENSITIES, 3)
