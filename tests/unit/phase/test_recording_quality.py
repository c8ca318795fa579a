"""The quick verdict on a recording agrees with how it was made."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.phase.recording_quality import recording_quality

FULL_SCALE, GAIN, READ_NOISE = 4095, 0.2, 2.0


def stepped(offset: float, amplitude: np.ndarray, rng: np.random.Generator, steps: int = 4) -> np.ndarray:
    """Return frames of fringes whose amplitude differs from pixel to pixel, with the camera's noise."""
    phase = rng.uniform(0.0, 2.0 * np.pi, amplitude.shape)
    level = offset + amplitude * np.cos(phase + 2.0 * np.pi * np.arange(steps)[:, None, None] / steps)
    noise = rng.standard_normal(level.shape) * np.sqrt(READ_NOISE**2 + GAIN * level)
    return np.clip(np.rint(level + noise), 0, FULL_SCALE).astype(np.uint16)


@pytest.mark.parametrize("steps", [3, 4, 7])
def test_modulation_is_found_where_there_are_fringes(rng: np.random.Generator, steps: int) -> None:
    amplitude = np.zeros((120, 100))
    amplitude[:, :40] = 900.0
    frames = stepped(1000.0, amplitude, rng, steps)
    found = recording_quality(frames, (frames >= FULL_SCALE).any(axis=0), FULL_SCALE, GAIN, READ_NOISE)
    # Noise alone exceeds 5 sigma of a Rayleigh distributed amplitude in exp(-12.5) = 4e-6 of 7,200 pixels.
    assert found.lit_fraction == pytest.approx(0.4, abs=2e-4)
    assert found.saturated_fraction == 0.0
    # A median of 4,800 amplitudes of deviation 14.3 sqrt(2/3): within 0.2, and four of these, of 900.
    assert found.modulation * FULL_SCALE == pytest.approx(900.0, abs=0.8 + 0.5)


def test_saturated_pixels_are_lit_and_counted(rng: np.random.Generator) -> None:
    amplitude = np.full((100, 100), 800.0)
    frames = stepped(1000.0, amplitude, rng)
    frames[:, :14] = FULL_SCALE
    saturated = (frames >= FULL_SCALE).any(axis=0)
    found = recording_quality(frames, saturated, FULL_SCALE, GAIN, READ_NOISE)
    assert found.lit_fraction == 1.0
    assert found.saturated_fraction == pytest.approx(0.14)


def test_darkness_is_not_lit(rng: np.random.Generator) -> None:
    frames = np.zeros((4, 50, 50), np.uint16)
    found = recording_quality(frames, np.zeros((50, 50), np.bool_), FULL_SCALE, GAIN, READ_NOISE)
    assert (found.lit_fraction, found.saturated_fraction, found.modulation) == (0.0, 0.0, 0.0)
