"""Simulated signals of one and several returns, and the least error that theory allows for them.

All for one fringe orientation with densities 0 .. s-1 and four phase steps, the two of density 0 that tell
nothing left out: 4 s - 2 frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.fringes.peeling import Peeled, peel_returns
from sms_jobs.bench.fringes.return_bounds import two_return_bound
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.phase.fourier_domain_ranging import Returns, range_returns
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.sequences import linear, ranging
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap

STEPS = 4
MODULATION = 1000.0  # grey levels of the strongest return: rounding is then a thousandth of the noise's power
FULL_SCALE = 65_535


@dataclass(frozen=True)
class Signals:
    """Frames of many pixels and what is true of them.

    Attributes
    ----------
    omega
        (returns, pixels) in rad, strongest first.
    amplitude
        (returns,) in grey levels.
    noise
        Standard deviation of a frame, in grey levels.
    fringes
        s.
    frames
        (4 s - 2, rows, columns), rows x columns being the pixels.
    """

    omega: Floats
    amplitude: Floats
    noise: float
    fringes: int
    frames: NDArray[np.uint16]

    @property
    def camera(self) -> GreyLevels:
        """Return the grey levels of the frames: their noise does not grow with the light."""
        return GreyLevels(FULL_SCALE, 0.0, self.noise)

    @property
    def apart_bins(self) -> Floats:
        """Return how far two returns are apart, (pixels,), in bins of 2 pi / s."""
        return np.abs(wrapped(self.omega[1] - self.omega[0])) * self.fringes / (2.0 * pi)

    def ranged(self, returns: int | None = None, **options: object) -> Returns:
        """Range the frames, by default for as many returns as there are."""
        return range_returns(
            self.frames,
            ranging(self.fringes),
            STEPS,
            self.camera,
            returns=returns or len(self.omega),
            **options,  # type: ignore[arg-type]
        )

    def peeled(self, returns: int | None = None, **options: object) -> Peeled:
        """Range the frames as in the thesis, likewise."""
        return peel_returns(
            self.frames,
            ranging(self.fringes),
            STEPS,
            self.camera,
            returns=returns or len(self.omega),
            **options,  # type: ignore[arg-type]
        )

    def unwrapped(self) -> PhaseGradient:
        """Unwrap the frames of the densities 1 .. s-1, the linear sequence."""
        frames = self.frames[2:]
        densities = linear(self.fringes - 1)
        return unwrap(frames, densities, STEPS, full_scale=FULL_SCALE, gain=0.0, read_noise=self.noise)


def wrapped(angle: Floats) -> Floats:
    """Bring angles to -pi .. pi."""
    return np.asarray(angle - 2.0 * pi * np.rint(angle / (2.0 * pi)))


def patterns(fringes: int) -> list[tuple[int, int]]:
    """Return (density, step) of every frame."""
    return [(t, k) for t in ranging(fringes) for k in (range(STEPS) if t else (0, STEPS // 2))]


def simulate(
    omega: Floats,
    ratios: Sequence[float],
    fringes: int,
    signal_to_noise: float,
    random: np.random.Generator,
    columns: int = 512,
    law: Literal["normal", "uniform"] = "normal",
) -> Signals:
    """Return frames of pixels whose returns have phase gradients `omega`, (returns, pixels), in rad.

    `ratios` are their amplitudes in units of the first; `signal_to_noise` is B / sigma of the first,
    and `law` how the noise is distributed.
    """
    amplitude = MODULATION * np.array(ratios)
    noise = MODULATION / signal_to_noise
    shape = (-1, columns)
    level = amplitude.sum() + 8.0 * noise
    frames = np.empty((4 * fringes - 2, omega.shape[1] // columns, columns), np.uint16)
    for i, (density, step) in enumerate(patterns(fringes)):
        angle = omega * density + 2.0 * pi * step / STEPS
        light = level + amplitude @ np.cos(angle)
        if law == "normal":
            light += noise * random.standard_normal(light.shape)
        else:
            light += noise * random.uniform(-sqrt(3.0), sqrt(3.0), light.shape)
        frames[i] = np.rint(light).reshape(shape)
    return Signals(omega, amplitude, noise, fringes, frames)


def pairs(pixels: int, bins: tuple[float, float], fringes: int, random: np.random.Generator) -> Floats:
    """Return two phase gradients a pixel, (2, pixels), in rad.

    The first is anywhere in -pi .. pi, the second to either side of it, `bins` of 2 pi / s away, uniformly.
    """
    first = random.uniform(-pi, pi, pixels)
    apart = random.uniform(*bins, pixels)
    side = random.choice([-1.0, 1.0], pixels)
    second = first + side * apart * 2.0 * pi / fringes
    return wrapped(np.stack([first, second]))


def single_bound(fringes: int, signal_to_noise: float) -> float:
    """Return the least standard deviation of omega of one return whose phase is known at t = 0, in rad.

    sigma / (B sqrt(q / 2 sum t^2)).
    """
    t = np.arange(fringes)
    return 1.0 / (signal_to_noise * sqrt(STEPS / 2.0 * float(np.sum(t * t))))


def stronger_bound(apart_bins: Floats, fringes: int, signal_to_noise: float) -> Floats:
    """Return the least standard deviation of omega of the stronger of two returns, in rad.

    By linear interpolation between 201 separations, which is exact to 1e-4 from 0.1 bins on.
    """
    grid = np.linspace(apart_bins.min(), apart_bins.max(), 201 if np.ptp(apart_bins) else 1)
    growth = [two_return_bound(float(one), fringes) for one in grid]
    return single_bound(fringes, signal_to_noise) * np.interp(apart_bins, grid, growth)


def found_near(signals: Signals, returns: Returns | Peeled) -> tuple[Floats, Mask]:
    """Return the error of the found return nearest to each true one, and where all are found.

    Found means within a quarter of a bin, each by a return of its own. Errors are (returns, pixels) in rad,
    NaN where nothing was found.
    """
    found = returns.omega.reshape(len(returns.omega), -1)
    errors = wrapped(found[None] - signals.omega[:, None])
    nearest = np.argmin(np.where(np.isnan(errors), np.inf, np.abs(errors)), axis=1)
    error = np.take_along_axis(errors, nearest[:, None], axis=1)[:, 0]
    near = np.abs(error) < 0.25 * 2.0 * pi / signals.fringes
    good: Mask = np.asarray(near.all(axis=0))
    if len(signals.omega) == 2:
        good &= nearest[0] != nearest[1]
    return error, good


def rms(values: Floats) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
