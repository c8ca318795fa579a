"""Micro and embedded phase shifting: phases, the errors that are stated, and few wrong fringe orders."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.frame_mishaps import Mishap
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.joint_check import JointFrames, agrees, find_joint_mishap
from sms_jobs.metrology.phase.joint_fit import JointCode, fit_jointly, with_transfer
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient
from sms_jobs.records.measurement import FringeSequence

MICRO = FringeSequence.with_counts(
    (64.0, 59.7, 60.9, 61.8, 62.9, 65.0, 66.1, 66.9, 67.8, 68.4), (3,) + (1,) * 9, (0.0,)
)
EMBEDDED = FringeSequence.with_counts((16, 17, 20), (3, 2, 2), (0.0,))
MEAN, MODULATION, FULL_SCALE = 1500.0, 1000.0, 4095


def code_of(sequence: FringeSequence) -> JointCode:
    shown = list(sequence.patterns())
    turns = np.array([2.0 * pi * step / sequence.steps for _, _, step in shown])
    densities = np.array([density for _, density, _ in shown], np.float64)
    return JointCode(densities, turns, sequence.frames_of_anchor(0), np.ones(len(shown)))


def recorded(
    omega: NDArray[np.float64], code: JointCode, grey: GreyLevels, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return noisy frames (frames, rows, columns) of what a code shows at phase gradients (rows, columns)."""
    wave = np.cos(np.multiply.outer(code.densities, omega) + code.turns[:, None, None])
    level = MEAN + MODULATION * code.transfer[:, None, None] * wave
    noisy = level + np.sqrt(grey.variance(level)) * rng.standard_normal(level.shape)
    return np.clip(np.rint(noisy), 0, FULL_SCALE).astype(np.uint16)


def wrong(found: PhaseGradient, omega: NDArray[np.float64], code: JointCode) -> NDArray[np.bool_]:
    return np.asarray(np.abs(found.omega - omega) > pi / code.densities.max())


@pytest.fixture
def omega(rng: np.random.Generator) -> NDArray[np.float64]:
    return rng.uniform(-pi, pi, (100, 200))


@pytest.mark.parametrize("sequence", [MICRO, EMBEDDED], ids=["micro", "embedded"])
@pytest.mark.parametrize("noise", [0.01, 0.04, 0.08])
def test_errors_are_those_stated_and_wrong_orders_are_told(
    sequence: FringeSequence, noise: float, omega: NDArray[np.float64], rng: np.random.Generator
) -> None:
    code = code_of(sequence)
    # Half of the variance at the mean is shot noise; 1/12 is that of whole grey levels.
    variance = (noise * MODULATION) ** 2
    grey = GreyLevels(FULL_SCALE + 1, 0.5 * variance / MEAN, float(np.sqrt(0.5 * variance)))
    frames = recorded(omega, code, grey, rng)
    found = fit_jointly(frames, code, grey)
    trusted = ~found.ambiguous
    # The probability of another order is below 1e-4 in each of 20,000 pixels: 2 are expected at most, and
    # 9 have a probability of 2e-4 (Poisson).
    assert wrong(found, omega, code)[trusted].sum() < 9
    error = ((found.omega - omega) / found.omega_sigma)[trusted & ~wrong(found, omega, code)]
    # The standard deviation of at least 10,000 errors is good to 0.7 %; 5 of these.
    assert error.size > 10_000
    assert np.std(error) == pytest.approx(1.0, abs=0.035)
    assert abs(error.mean()) < 5.0 / np.sqrt(error.size)
    # chi-square of the frames beyond three unknowns: its mean is their number.
    sigma = np.sqrt(2.0 / code.steps * grey.variance(found.mean_intensity)) / found.modulation
    reduced = np.square(found.phase_error / sigma)[trusted]
    assert reduced.mean() == pytest.approx(
        1.0, abs=0.12
    )  # ambiguous pixels, whose squares are larger, are out


def test_all_pixels_of_a_clear_recording_are_told(rng: np.random.Generator) -> None:
    code, grey = code_of(EMBEDDED), GreyLevels(FULL_SCALE, 0.0, 5.0)
    omega = rng.uniform(-0.98 * pi, 0.98 * pi, (50, 50))
    found = fit_jointly(recorded(omega, code, grey, rng), code, grey)
    assert not (found.ambiguous | found.saturated).any()
    assert not wrong(found, omega, code).any()
    np.testing.assert_allclose(found.modulation, MODULATION, atol=30.0)
    np.testing.assert_allclose(found.mean_intensity, MEAN, atol=30.0)


def test_a_dim_pixel_is_ambiguous_and_a_bright_one_saturated(rng: np.random.Generator) -> None:
    code, grey = code_of(MICRO), GreyLevels(2400, 0.0, 5.0)
    omega = np.linspace(-3.0, 3.0, 200)[None]
    frames = recorded(omega, code, grey, rng)
    found = fit_jointly(frames, code, grey)
    np.testing.assert_array_equal(found.saturated, (frames >= 2400).any(axis=0))
    assert np.isnan(found.omega[found.saturated]).all()
    dark = np.rint(20.0 + 5.0 * rng.standard_normal(frames.shape)).clip(0).astype(np.uint16)
    assert fit_jointly(dark, code, grey).ambiguous.mean() > 0.99


def test_threads_change_nothing(omega: NDArray[np.float64], rng: np.random.Generator) -> None:
    code, grey = code_of(EMBEDDED), GreyLevels(FULL_SCALE, 0.1, 5.0)
    frames = recorded(omega, code, grey, rng)
    one, two = fit_jointly(frames, code, grey), fit_jointly(frames, code, grey, threads=2)
    np.testing.assert_array_equal(one.omega, two.omega)


def test_what_blur_leaves_of_each_density_is_found(
    omega: NDArray[np.float64], rng: np.random.Generator
) -> None:
    grey, told = GreyLevels(FULL_SCALE, 0.1, 10.0), code_of(EMBEDDED)
    true = replace(told, transfer=np.repeat([1.0, 0.97, 0.88], [3, 2, 2]))
    frames = recorded(omega, true, grey, rng)
    found = with_transfer(frames, told, grey)
    # Of 20,000 pixels with noise of 0.016 of the modulation: 0.0002 and rounding.
    np.testing.assert_allclose(found.transfer, true.transfer, atol=1e-3)
    one, other = (fit_jointly(frames, code, grey) for code in (found, told))
    trusted = ~one.ambiguous & ~other.ambiguous
    assert np.std(((one.omega - omega) / one.omega_sigma)[trusted]) == pytest.approx(1.0, abs=0.035)
    assert np.std(((other.omega - omega) / other.omega_sigma)[trusted]) > 1.2


def _exchanged(frames: NDArray[np.uint16]) -> NDArray[np.uint16]:
    swapped = frames.copy()
    swapped[[4, 9]] = frames[[9, 4]]
    return swapped


def _dark(frames: NDArray[np.uint16]) -> NDArray[np.uint16]:
    darkened = frames.copy()
    darkened[7] = 30
    return darkened


@pytest.mark.parametrize(
    ("happened", "mishap"),
    [(_exchanged, Mishap("exchanged", (4, 9))), (_dark, Mishap("other", (7,)))],
    ids=["exchanged", "dark"],
)
def test_a_mishap_is_named(
    happened: object, mishap: Mishap, omega: NDArray[np.float64], rng: np.random.Generator
) -> None:
    code, grey = code_of(MICRO), GreyLevels(FULL_SCALE, 0.1, 10.0)
    right = recorded(omega, code, grey, rng)
    assert agrees(JointFrames(right.reshape(12, -1), code, grey, 0.02).share())
    told = JointFrames(happened(right).reshape(12, -1), code, grey, 0.02)  # type: ignore[operator]
    assert not agrees(told.share())
    assert find_joint_mishap(told) == mishap


def test_a_wrong_number_of_fringes_is_named(omega: NDArray[np.float64], rng: np.random.Generator) -> None:
    code, grey = code_of(EMBEDDED), GreyLevels(FULL_SCALE, 0.1, 10.0)
    frames = recorded(omega, code, grey, rng).reshape(7, -1)
    wrong_code = replace(code, densities=np.where(code.densities == 17.0, 18.0, code.densities))
    told = JointFrames(frames, wrong_code, grey, 0.02)
    assert not agrees(told.share())
    assert find_joint_mishap(told) == Mishap("count", stated=18.0, actual=17.0)


@pytest.mark.parametrize(
    ("densities", "counts", "message"),
    [
        ((16, 17), (1, 1), "one density at least needs three phase steps"),
        ((16, 17), (3,), "one for each of the 2 densities"),
        ((16, 17), (3, 0), "at least 1"),
        ((16, 16), (3, 1), "all different"),
        ((16, 0), (3, 1), "above 0"),
    ],
)
def test_steps_that_cannot_tell_a_phase_are_refused(
    densities: tuple[int, ...], counts: tuple[int, ...], message: str
) -> None:
    with pytest.raises(InvalidInput, match=message):
        FringeSequence.with_counts(densities, counts, (0.0,))


def test_steps_are_equal_parts_of_a_turn_and_two_are_a_quarter_apart() -> None:
    assert EMBEDDED.steps == 12
    assert EMBEDDED.shown == ((0, 4, 8), (0, 3), (0, 3))
    assert (EMBEDDED.frames, EMBEDDED.counts, EMBEDDED.anchor) == (7, (3, 2, 2), 0)
    assert EMBEDDED.in_words == "densities 16, 17, 20 x 3, 2, 2 steps"
    assert FringeSequence.with_counts((9, 3), (4, 4), (0.0,)) == FringeSequence((9, 3), 4, (0.0,))
