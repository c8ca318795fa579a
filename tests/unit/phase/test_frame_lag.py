"""What frames hold of the light of their neighbours, on frames made from the equations."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.phase.frame_fit import SampledFrames, fit_frames
from sms_jobs.metrology.phase.frame_lag import NEIGHBOURS, FrameLag, Neighbour, find_lag, without_lag
from sms_jobs.metrology.phase.grey_levels import GreyLevels

GREY = GreyLevels(4095, 0.1, 2.0)
PIXELS = 2000
Floats = NDArray[np.float64]


def shown(
    rng: np.random.Generator, densities: tuple[float, ...], steps: int, second: float = 0.0
) -> tuple[Floats, Floats]:
    """Return omega (pixels,) of random pixels and what they see (frames, pixels), with a second harmonic."""
    omega = rng.uniform(-pi, pi, PIXELS)
    modulation = rng.uniform(300.0, 900.0, PIXELS)
    theta = [omega * t + 2.0 * pi * k / steps for t in densities for k in range(steps)]
    return omega, np.array([modulation * (1.5 + np.cos(a) + second * np.cos(2.0 * a)) for a in theta])


def mixed(levels: Floats, part: float, neighbour: Neighbour) -> Floats:
    """Return what a camera sees of frames that hold a part of their neighbours."""
    beside = np.roll(levels, 1 if neighbour == "before" else -1, axis=0)
    edge = 0 if neighbour == "before" else -1
    beside[edge] = levels[edge]
    return (1.0 - part) * levels + part * beside


def told(rng: np.random.Generator, levels: Floats, densities: tuple[float, ...], steps: int) -> SampledFrames:
    """Return the frames with noise."""
    noisy = levels + np.sqrt(GREY.variance(levels)) * rng.standard_normal(levels.shape)
    return SampledFrames(np.clip(np.rint(noisy), 0, 4095).astype(np.uint16), densities, steps, GREY, 0.02)


def found(seen: SampledFrames, neighbour: Neighbour) -> FrameLag:
    return find_lag(
        [fit_frames(seen)], seen.levels.astype(np.float32), [np.arange(len(seen.levels))], neighbour
    )


CASES = [((16.0, 15.0, 14.0, 12.0, 8.0), 4), ((1.0, 3.0, 9.0, 27.0), 5), (tuple(map(float, range(1, 12))), 4)]


@pytest.mark.parametrize("neighbour", NEIGHBOURS)
@pytest.mark.parametrize(("densities", "steps"), CASES)
@pytest.mark.parametrize("second", [0.0, 0.1])
def test_the_part_of_a_neighbour_and_what_it_does_to_phases_are_found(
    densities: tuple[float, ...], steps: int, neighbour: Neighbour, second: float, rng: np.random.Generator
) -> None:
    omega, levels = shown(rng, densities, steps, second)
    # Phases alone would have to agree to 0.02 rad, as they do as long as this is small.
    seen = told(rng, mixed(levels, 0.015, neighbour), densities, steps)
    lag = found(seen, neighbour)
    # To first order: the change of the second is as the square of the part.
    assert lag.part == pytest.approx(0.015, abs=5.0 * lag.sigma + 2.0 * 0.015**2)
    assert 10.0 * lag.sigma < 0.015
    fit = fit_frames(seen)
    good = fit.consistent
    off = np.angle(fit.model.expected[:, good] * np.exp(-1j * np.multiply.outer(densities, omega[good])))
    shift = np.mean(off[-1] / densities[-1])
    scatter = np.std(off[-1] / densities[-1]) / np.sqrt(np.count_nonzero(good))
    # Of all that it moves phases by, as much is known as of the part.
    assert lag.shift[0] == pytest.approx(shift, abs=5.0 * scatter + 0.1 * abs(shift))
    assert abs(shift) > 10.0 * scatter
    other = found(seen, "after" if neighbour == "before" else "before")
    assert other.explained < lag.explained


def test_frames_without_a_lag_have_none_and_the_deviation_is_true(rng: np.random.Generator) -> None:
    densities, steps = CASES[0]
    z = []
    for _ in range(40):
        _, levels = shown(rng, densities, steps)
        seen = told(rng, levels, densities, steps)
        z += [lag.part / lag.sigma for lag in (found(seen, one) for one in NEIGHBOURS)]
    # The larger of two deviations, of which that over five densities scatters by a third: 80 draws of a
    # ratio whose rms lies within 0.6 and 1.1.
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.2
    assert np.abs(z).max() < 6.0


def test_a_lamp_that_flickers_is_no_lag(rng: np.random.Generator) -> None:
    densities, steps = CASES[0]
    _, levels = shown(rng, densities, steps)
    light = 0.02 * np.cos(2.0 * np.arange(len(levels)))
    seen = told(rng, levels + light[:, None] * levels.mean(axis=0), densities, steps)
    for neighbour in NEIGHBOURS:
        lag = found(seen, neighbour)
        assert lag.part < 6.0 * lag.sigma


def test_frames_that_are_told_to_have_no_noise_are_whole_numbers(rng: np.random.Generator) -> None:
    densities, steps = CASES[0]
    _, levels = shown(rng, densities, steps)
    for part in (0.0, 0.01):
        frames = np.rint(mixed(levels, part, "before")).astype(np.uint16)
        lag = found(SampledFrames(frames, densities, steps, GreyLevels(4095, 0.0, 0.0), 0.02), "before")
        assert lag.part == pytest.approx(part, abs=5.0 * lag.sigma + 2.0 * part**2)
        assert 0.0 < lag.sigma < 1e-3


@pytest.mark.parametrize("neighbour", NEIGHBOURS)
def test_without_the_part_frames_are_as_they_were_shown(
    neighbour: Neighbour, rng: np.random.Generator
) -> None:
    _, levels = shown(rng, *CASES[0])
    apart = without_lag(mixed(levels, 0.4, neighbour), 0.4, neighbour)
    np.testing.assert_allclose(apart, levels, rtol=1e-9)  # an error of rounding grows by 2/3 a frame


def test_where_no_pixel_is_consistent_nothing_is_known(rng: np.random.Generator) -> None:
    densities, steps = CASES[1]
    _, levels = shown(rng, densities, steps)
    fit = fit_frames(told(rng, levels, densities, steps))
    none = replace(fit, consistent=np.zeros(PIXELS, bool))
    lag = find_lag([none], levels.astype(np.float32), [np.arange(len(levels))], "before")
    assert (lag.part, lag.sigma, lag.shift, lag.scatter) == (0.0, np.inf, (0.0,), (0.0,))
