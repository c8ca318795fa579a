"""Fringes beside a Gray code to which something happened are refused by name; the others are not."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.measured_plate import reconstructed as plainly_reconstructed
from support.measured_plate import simulated

from sms_jobs.bench.fringes.code_mishaps import CODED, code_mishaps, coded_session
from sms_jobs.bench.fringes.fringe_mishaps import Session, is_named, reconstructed, silent_points
from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.shape.frame_lines import FrameLines
from sms_jobs.records.gray_code import GrayCode
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason


@pytest.mark.parametrize("number", range(len(CODED)))
def test_each_mishap_is_named(number: int) -> None:
    random = np.random.default_rng(20 + number)
    session = coded_session(random, CODED[number], plain=True)
    each = list(code_mishaps(session, random))
    assert len(each) >= 11
    for mishap in each:
        surface, said = reconstructed(session, mishap.measurement)
        assert surface is None, mishap.name
        assert is_named(mishap, said), f"{mishap.name}: {said}"


@pytest.mark.parametrize("seed", [10, 18, 26])
def test_a_word_about_all_frames_comes_before_steps_that_look_alike(seed: int) -> None:
    # Steps of one direction are counted into the next, where two of them look alike at these places.
    random = np.random.default_rng(seed)
    session = coded_session(random, CODED[2])
    (mishap,) = (m for m in code_mishaps(session, random) if m.name == "code: steps")
    _, said = reconstructed(session, mishap.measurement)
    assert "they are runs of 6 phase steps, not of 7: correct the phase steps" in said


@pytest.mark.parametrize(
    "seed", [pytest.param(one, marks=() if one < 8 else pytest.mark.long) for one in range(50)]
)
def test_a_recording_to_which_nothing_happened_is_not_refused(seed: int) -> None:
    # Noise up to 100 levels of 4095, exponents up to 2.2, depth steps, holes, folds, half the modulation.
    session = coded_session(np.random.default_rng(3000 + seed), hard=True)
    _, said = reconstructed(session, session.measurement)
    assert said == ""


@pytest.fixture(scope="module")
def session() -> Session:
    return coded_session(np.random.default_rng(5), CODED[0], plain=True)


def test_a_good_recording_is_right(session: Session) -> None:
    surface, said = reconstructed(session, session.measurement)
    assert said == ""
    assert surface is not None
    assert (surface.reason == Reason.VALID)[session.shape.lit].mean() > 0.9
    assert silent_points(session, surface) == 0


def test_what_one_direction_cannot_tell_apart_is_said_as_either() -> None:
    one = coded_session(np.random.default_rng(5), CODED[7], plain=True)
    frames = one.measurement.frames.rows(0, 128)[[0, 3, 2, 1, *range(4, 14)]]
    _, said = reconstructed(one, replace(one.measurement, frames=ArrayStack(frames)))
    assert (
        "along 0 deg either the phase steps run the other way than the code, or bit 0 is inverted, or" in said
    )
    assert "frames 1 (16 fringes along 0 deg, step 1) and 3 (16 fringes along 0 deg, step 3)" in said


def changed(session: Session, frames: NDArray[Any]) -> Measurement:
    return replace(session.measurement, frames=ArrayStack(frames))


def test_phases_of_chance_are_refused(session: Session) -> None:
    frames = session.measurement.frames.rows(0, 128).copy()
    own = session.measurement.sequence.frames_of(0)
    frames[own] = np.random.default_rng(3).integers(200, 3000, frames[own].shape)
    _, said = reconstructed(session, changed(session, frames))
    assert "neighbouring pixels have nothing to do with each other" in said


def test_a_dark_step_of_four_is_refused_without_a_name(session: Session) -> None:
    frames = session.measurement.frames.rows(0, 128).copy()
    frames[2] = 40
    _, said = reconstructed(session, changed(session, frames))
    assert "nothing tells which frame it is: record them again" in said


def test_fringes_that_begin_at_another_step_lie_beside_the_code(session: Session) -> None:
    told = replace(session.measurement, phase_offsets_rad=(pi / 2.0,))
    _, said = reconstructed(session, told)
    assert "the fringes lie 1.6 rad beside the code, and 0.2 rad are accepted" in said


def test_few_lit_pixels_say_nothing(session: Session) -> None:
    frames = session.measurement.frames.rows(0, 128).copy()
    frames[:, 8:, :] = 40
    frames[:4] = frames[[0, 3, 2, 1]]
    _, said = reconstructed(session, changed(session, frames))
    assert said == ""


def test_two_densities_are_checked_against_each_other_too() -> None:
    one = coded_session(np.random.default_rng(6), CODED[6], plain=True)
    told = replace(one.measurement.sequence, densities=(47, 32))
    _, said = reconstructed(one, replace(one.measurement, sequence=told))
    assert "47 fringes are stated, but the phases are those of 48" in said


def test_lines_are_the_same_whatever_slabs_they_come_from(rng: np.random.Generator) -> None:
    frames = rng.integers(0, 4000, (6, 100, 150)).astype(np.uint16)
    taken = []
    for height in (100, 64, 16):
        lines = FrameLines(100, 150)
        for start in range(0, 100, height):
            rows = slice(start, min(start + height, 100))
            lines.take(rows, frames[:, rows])
        taken.append(lines.stacked())
    # 100 / 8 and 150 / 8 lines.
    assert taken[0][0].shape == (6, 12 * 150 + 18 * 100)
    assert taken[0][1].sum() == 12 + 18
    for other in taken[1:]:
        for one, two in zip(taken[0], other, strict=True):
            np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("stripes", [16.0, 40.0, 64.0])
def test_a_linear_rig_with_any_stripes_is_accepted(stripes: float) -> None:
    code = GrayCode(int(np.ceil(np.log2(stripes))), (stripes,), "inverse")
    calibration, measurement, _ = simulated(FringeSequence((16,), 4, (0.0, pi / 2), gray=code))
    surface = plainly_reconstructed(calibration, measurement)
    assert (surface.reason == Reason.VALID).mean() > 0.25
    told = replace(measurement, sequence=replace(measurement.sequence, densities=(15,)))
    with pytest.raises(MeasurementFailed, match="15 fringes are stated, but the phases are those of 16"):
        plainly_reconstructed(calibration, told)
