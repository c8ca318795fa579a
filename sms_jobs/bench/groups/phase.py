"""Phase: the speed of temporal unwrapping."""

from __future__ import annotations

from collections.abc import Iterator
from math import pi

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run, cpu_seconds
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap

REVERSE_EXPONENTIAL = (32, 31, 30, 28, 24, 16)
STEPS = 4
_ROWS, _COLUMNS = 512, 1024


def fringe_frames(rows: int, columns: int, seed: int = 1) -> tuple[NDArray[np.float64], NDArray[np.uint16]]:
    """Return phase gradients anywhere in -pi .. pi, (rows, columns), and noisy frames of them."""
    random = np.random.default_rng(seed)
    omega = random.uniform(-pi, pi, (rows, columns))
    frames = np.empty((len(REVERSE_EXPONENTIAL) * STEPS, rows, columns), np.uint16)
    for i, density in enumerate(REVERSE_EXPONENTIAL):
        for step in range(STEPS):
            level = 1500.0 + 1000.0 * np.cos(omega * density + 2.0 * pi * step / STEPS)
            noise = 20.0 * random.standard_normal(level.shape, np.float32)
            frames[i * STEPS + step] = np.rint(level + noise)
    return omega, frames


def unwrap_frames(frames: NDArray[np.uint16]) -> PhaseGradient:
    """Unwrap such frames with all that is known of their noise, on one thread."""
    return unwrap(frames, REVERSE_EXPONENTIAL, STEPS, full_scale=4095, gain=0.1, read_noise=3.0)


def warm_up() -> None:
    """Compile what the rates use."""
    unwrap_frames(fringe_frames(2, 16)[1])


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    rows = _ROWS // (4 if run.quick else 1)
    _, frames = fringe_frames(rows, _COLUMNS)
    rate = frames.size / 1e6 / cpu_seconds(lambda: unwrap_frames(frames))
    yield Figure("reverse_exponential_mpx_frames_per_cpu_s", rate, "Mpx frames / CPU-s", 400.0)
    densities = ", ".join(map(str, REVERSE_EXPONENTIAL))
    yield Condition(
        "reverse_exponential",
        f"fringes {densities}, {STEPS} steps, {_COLUMNS} x {rows} px, uint16 frames in memory, phase "
        "gradient with residual, modulation, standard deviation and flags; one thread",
    )


GROUP = Group("phase", "speed of temporal unwrapping", warm_up, measure)
