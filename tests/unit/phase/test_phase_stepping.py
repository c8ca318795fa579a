"""Phase stepping: any number of steps, any offset, and an arctangent that is one."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.phase_stepping import angle, phase_sigma, stepping_weights


@pytest.mark.parametrize("steps", [3, 4, 5, 7, 8, 16])
def test_stepped_frames_give_modulation_and_phase(steps: int) -> None:
    phi = np.linspace(-3.1, 3.1, 41)
    frames = 500.0 + 120.0 * np.cos(phi + 2.0 * np.pi * np.arange(steps)[:, None] / steps)
    cosine, sine = stepping_weights(steps) @ frames
    np.testing.assert_allclose(cosine + 1j * sine, 120.0 * np.exp(1j * phi), atol=1e-10)  # rounding of 500


def test_four_steps_are_the_thesis_formula(rng: np.random.Generator) -> None:
    frames = rng.uniform(0.0, 4095.0, size=(4, 100))
    cosine, sine = stepping_weights(4) @ frames
    # Eq. (1.17), its frames 1 .. 4 being 0 .. 3 here.
    expected = np.arctan2(frames[3] - frames[1], frames[0] - frames[2])
    np.testing.assert_allclose(np.arctan2(sine, cosine), expected, atol=1e-12)


def test_two_steps_are_too_few() -> None:
    with pytest.raises(InvalidInput, match="at least 3 steps, not 2"):
        stepping_weights(2)


def test_angle_is_the_arctangent(rng: np.random.Generator) -> None:
    s, c = rng.normal(size=(2, 20_000)) * 10.0 ** rng.uniform(-6.0, 6.0, size=20_000)
    found = np.array([angle(float(a), float(b)) for a, b in zip(s, c, strict=True)])
    # The first term that the series leaves out is 2 (sqrt(2) - 1)^25 / 25 = 2e-11.
    np.testing.assert_allclose(found, np.arctan2(s, c), atol=1e-10)


@pytest.mark.parametrize(
    ("s", "c"), [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (-1.0, 0.0), (0.0, -1.0), (1.0, 1.0)]
)
def test_angle_on_the_axes(s: float, c: float) -> None:
    assert angle(s, c) == pytest.approx(np.arctan2(s, c), abs=1e-10)


@pytest.mark.parametrize("steps", [3, 4, 9])
def test_phase_noise_is_as_predicted(steps: int, rng: np.random.Generator) -> None:
    noise, modulation, trials = 4.0, 200.0, 20_000
    phi = rng.uniform(-np.pi, np.pi, size=trials)
    frames = modulation * np.cos(phi + 2.0 * np.pi * np.arange(steps)[:, None] / steps)
    cosine, sine = stepping_weights(steps) @ (frames + rng.normal(scale=noise, size=frames.shape))
    error = np.angle((cosine + 1j * sine) * np.exp(-1j * phi))
    # The standard deviation of 20,000 samples scatters by 0.5 %; four times that, and (sigma / B)^2 = 4e-4.
    assert np.std(error) == pytest.approx(phase_sigma(noise, modulation, steps), rel=0.02)
