"""Speed of Fourier domain ranging from frames in memory; run with `pytest --benchmark-only`."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from sms_jobs.metrology.phase.fourier_domain_ranging import range_returns
from sms_jobs.metrology.phase.grey_levels import GreyLevels

S = 64
ROWS, COLUMNS = 64, 1024
NOISE = 20.0


def frames_of(rng: np.random.Generator, amplitudes: tuple[float, ...]) -> np.ndarray:
    """Return 4 s - 2 frames; a second return is 3 to 20 bins from the first one."""
    first = rng.uniform(-pi, pi, (ROWS, COLUMNS))
    view = (first, first + rng.uniform(3.0, 20.0, first.shape) * 2.0 * pi / S)
    omegas = view[: len(amplitudes)]
    frames = []
    for t in range(S):
        for k in (0, 2) if t == 0 else range(4):
            waves = [
                a * np.cos(w * t + pi / 2.0 * k)
                for a, w in zip(amplitudes, omegas[: len(amplitudes)], strict=True)
            ]
            frames.append(3000.0 + sum(waves) + rng.normal(scale=NOISE, size=first.shape))
    return np.rint(frames).astype(np.uint16)


@pytest.mark.parametrize("amplitudes", [(1000.0,), (1000.0, 500.0)], ids=["one", "two"])
def test_ranging_of_254_frames(
    amplitudes: tuple[float, ...], benchmark: BenchmarkFixture, rng: np.random.Generator
) -> None:
    frames = frames_of(rng, amplitudes)
    benchmark(
        range_returns,
        frames,
        tuple(range(S)),
        4,
        GreyLevels(65_535, 0.0, NOISE),
        returns=len(amplitudes),
    )
    benchmark.extra_info["Mpx per second"] = ROWS * COLUMNS / benchmark.stats["min"] / 1e6
