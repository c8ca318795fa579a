"""What frames leave unexplained, and whether a scene stood still, on frames made from the equations."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.images.frame_motion import image_shifts
from sms_jobs.metrology.phase.frame_fit import SampledFrames, fit_frames, lit_pixels, share_by_chance
from sms_jobs.metrology.phase.frame_mishaps import find_mishap
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.phase_jumps import find_jump
from sms_jobs.metrology.phase.temporal_unwrapping import CoarseGradient

GREY = GreyLevels(4095, 0.1, 2.0)
DENSITIES = (16, 15, 14, 12, 8)
STEPS = 4
PIXELS = 4000


def sampled(
    rng: np.random.Generator, jump: NDArray[np.float64] | None = None, second: float = 0.0
) -> SampledFrames:
    """Return frames of random pixels; `jump` is added to omega by density, `second` is a harmonic."""
    omega = rng.uniform(-pi, pi, PIXELS)
    modulation = rng.uniform(300.0, 900.0, PIXELS)
    frames = []
    for i, t in enumerate(DENSITIES):
        own = omega + (0.0 if jump is None else jump[i])
        for k in range(STEPS):
            theta = own * t + 2.0 * pi * k / STEPS
            level = 1.2 * modulation + modulation * (np.cos(theta) + second * np.cos(2.0 * theta))
            noise = np.sqrt(GREY.variance(level)) * rng.standard_normal(PIXELS)
            frames.append(np.clip(np.rint(level + noise), 0, 4095))
    return SampledFrames(np.array(frames, np.uint16), DENSITIES, STEPS, GREY, 0.02)


@pytest.mark.parametrize("second", [0.0, 0.2])
def test_frames_as_they_should_be_leave_noise(second: float, rng: np.random.Generator) -> None:
    one = sampled(rng, second=second)
    fit = fit_frames(one)
    # Of 20 frames 7 numbers are fitted, and what is accepted lies beside the noise.
    assert fit.misfit.max() < 13.0 / 20.0
    assert fit.agrees
    # 99.9 % pass; four standard deviations of a count of 4 in 4000.
    assert fit.share > 0.999 - 4.0 * np.sqrt(0.001 / PIXELS)
    assert (np.abs(fit.shift) < 5.0 * fit.shift_sigma).all()
    assert find_jump(fit, DENSITIES) is None or abs(find_jump(fit, DENSITIES).change_rad) < 0.005


@pytest.mark.parametrize("light", [0.0, 3.0, 10.0])
@pytest.mark.parametrize("second", [0.0, 0.1])
def test_what_phases_scatter_by_beyond_noise_is_their_excess(
    light: float, second: float, rng: np.random.Generator
) -> None:
    """Of light that each frame has besides, the same at all pixels: it moves phases as noise of its size."""
    one = sampled(rng, second=second)
    # Alternating signs and steps would be a harmonic or a mean: of ten draws of twenty frames.
    found = []
    for _ in range(10):
        besides = light * rng.standard_normal(len(one.levels))
        levels = np.clip(np.rint(one.levels + besides[:, None]), 0, 4095).astype(np.uint16)
        found.append(fit_frames(replace(one, levels=levels)).excess)
    mean = one.levels.mean(axis=0)
    expected = light**2 * float(np.mean(1.0 / GREY.variance(mean)))
    # Sums of ten times four squares, to 0.23 of themselves; consistent pixels alone have a little less.
    assert np.mean(found) == pytest.approx(expected, rel=0.7, abs=1e-9)
    assert (light == 0.0) == (max(found) == 0.0)


@pytest.mark.parametrize("light", [0.0, 20.0])
def test_a_single_density_tells_of_other_light_by_all_its_frames(
    light: float, rng: np.random.Generator
) -> None:
    found = []
    for _ in range(20):
        omega = rng.uniform(-pi, pi, (1, PIXELS))
        level = 700.0 + 500.0 * np.cos(16 * omega + 2.0 * pi * np.arange(6)[:, None] / 6)
        level += light * rng.standard_normal((6, 1))
        noisy = level + np.sqrt(GREY.variance(level)) * rng.standard_normal(level.shape)
        frames = np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)
        coarse = CoarseGradient(omega, 0.01)
        found.append(fit_frames(SampledFrames(frames, (16,), 6, GREY, 0.02, coarse=coarse)).excess)
    # Three of six degrees of freedom are left: a mean of sixty squares, to 0.18; harmonics take up nothing.
    assert np.mean(found) == pytest.approx(light**2 / float(GREY.variance(np.array(700.0))), rel=0.5)
    assert (light == 0.0) == (max(found) == 0.0)


def test_a_frame_that_departs_is_guilty_alone(rng: np.random.Generator) -> None:
    one = sampled(rng)
    levels = one.levels.copy()
    levels[6] = np.rint(0.9 * levels[6])
    told = replace(one, levels=levels)
    fit = fit_frames(told)
    assert fit.guilty[1, 2]
    found = find_mishap((told,), (fit,))
    assert found is not None
    assert (found.what, found.frames) == ("gain", (6,))
    assert found.actual == pytest.approx(0.9, abs=0.01)


def test_a_whole_list_of_another_family_is_found(rng: np.random.Generator) -> None:
    told = replace(sampled(rng), densities=(1, 2, 4, 8, 16))
    found = find_mishap((told,), (fit_frames(told),))
    assert found is not None
    assert (found.what, found.densities) == ("list", DENSITIES)


def test_a_jump_is_found_where_it_is(rng: np.random.Generator) -> None:
    change = 0.2 / 16.0
    one = sampled(rng, jump=np.array([0.0, 0.0, change, change, change]))
    fit = fit_frames(one)
    assert fit.few_agree
    found = find_jump(fit, DENSITIES)
    assert found is not None
    assert (found.before, found.after) == (1, 2)
    # A phase scatters by 0.03 rad and more; the median of 4000 is good to 0.002 rad at a guess of ten times.
    assert found.change_rad == pytest.approx(0.2, abs=0.02)


def test_phases_of_different_pixels_agree_by_chance_alone(rng: np.random.Generator) -> None:
    one = sampled(rng)
    by_chance = share_by_chance(one)
    mixed = one.levels.reshape(len(DENSITIES), STEPS, PIXELS)
    shuffled = np.concatenate([levels[:, rng.permutation(PIXELS)] for levels in mixed])
    assert by_chance < 0.05
    assert fit_frames(replace(one, levels=shuffled)).share < 2.0 * by_chance


def test_pixels_without_fringes_or_range_are_not_lit(rng: np.random.Generator) -> None:
    one = sampled(rng)
    levels = one.levels.copy()
    levels[:, :100] = np.rint(200.0 + 5.0 * rng.standard_normal((len(levels), 100)))
    levels[3:7, 100:200] = 4095
    lit = lit_pixels(levels, GREY)
    assert not lit[:200].any()
    assert lit[200:].all()


def test_a_shift_is_found_with_the_error_that_is_stated(rng: np.random.Generator) -> None:
    x = np.arange(18.0)[None, None, :] + 40.0 * np.arange(32.0)[:, None, None]
    y = np.arange(2.0)[None, :, None] + 7.0 * np.arange(32.0)[:, None, None]

    def texture(dx: float, dy: float, lamp: float) -> NDArray[np.float64]:
        u, v = x - dx, y - dy
        return np.asarray(
            lamp * (1000.0 + 200.0 * np.sin(u / 2.1 + 1.3 * v) + 200.0 * np.cos(v / 1.9 - u / 3.0))
        )

    true = np.array([[0.0, 0.0], [0.05, 0.0], [0.0, -0.05], [0.05, 0.05]])
    images = np.stack([texture(dx, dy, 1.0 + 0.02 * i) for i, (dx, dy) in enumerate(true)])
    noisy = (images + 3.0 * rng.standard_normal(images.shape)).astype(np.float32)
    found = image_shifts(noisy, np.ones(noisy.shape[1:], np.bool_), 3.0)
    # Second order in the shift and in the step from pixel to pixel costs a tenth of it.
    off = found.shift - (true - true.mean(axis=0))
    assert (np.abs(off) < 0.005 + 5.0 * found.sigma).all()
    assert found.sigma.max() < 0.005


def test_an_image_without_texture_tells_no_shift(rng: np.random.Generator) -> None:
    flat = (1000.0 + 3.0 * rng.standard_normal((4, 32, 2, 18))).astype(np.float32)
    assert np.isnan(image_shifts(flat, np.ones(flat.shape[1:], np.bool_), 3.0).shift).all()
