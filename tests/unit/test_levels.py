"""Levels of a stepped test: which load a reading is near, when one is held, and what its state is called."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.instruments.level_detector import LevelDetector
from sms_jobs.records.levels import Levels, next_label
from sms_jobs.records.triggers import Holding

LEVELS = Levels("load_n", "kN", 10.0, 0.2, 10.0)
STEPS = [0.1, 0.3, 1.0, 7.0, 10.0, 2500.0, 1e-3]


@pytest.mark.parametrize("step", STEPS)
def test_a_reading_is_near_a_multiple_and_no_other(step: float, rng: np.random.Generator) -> None:
    levels = replace(LEVELS, step=step, tolerance=0.49 * step)
    for number in rng.integers(-500, 500, 200):
        # A twelfth digit of the level, of 500 steps, is 5e-10 of a step at most.
        level = levels.near(float(number) * step)
        assert level == pytest.approx(number * step, abs=1e-9 * step)
        for off in (-0.48, 0.48):
            assert levels.near((number + off) * step) == level
        assert levels.near((number + 0.5) * step) is None


def test_a_level_is_what_a_person_would_write() -> None:
    assert [replace(LEVELS, step=0.1, tolerance=0.01).near(0.1 * n) for n in range(4)] == [0.0, 0.1, 0.2, 0.3]


def test_zero_has_no_sign() -> None:
    assert math.copysign(1.0, LEVELS.near(-0.1) or 0.0) == 1.0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e308 * 10])
def test_what_is_no_number_is_near_nothing(value: float) -> None:
    assert LEVELS.near(value) is None
    assert replace(LEVELS, step=1e-300, tolerance=1e-301).near(1e10) is None


def test_a_recording_at_a_level_waits_for_that() -> None:
    assert LEVELS.at(20.0) == Holding("load_n", "kN", 20.0, 0.2, 10.0)
    assert str(LEVELS) == "load_n = any multiple of 10 +- 0.2 kN for 10 s"


def reached(detector: LevelDetector, readings: list[tuple[float, float]]) -> list[float]:
    return [time for time, value in readings if detector.held(time, value)]


def test_a_level_is_held_once_it_was_stayed_at_for_the_time() -> None:
    readings = [(float(t), 10.0 + 0.19 * (-1) ** t) for t in range(15)]
    assert reached(LevelDetector(LEVELS, None), readings)[0] == 10.0


def test_the_last_level_does_not_count_however_long_it_is_held() -> None:
    an_hour = [(0.2 * t, 9.9) for t in range(5 * 3600)]
    assert reached(LevelDetector(LEVELS, 10.0), an_hour) == []
    # And drifts, as long as it is near no other one.
    away = [(0.2 * t, 10.0 + 0.001 * t) for t in range(9000)]
    assert reached(LevelDetector(LEVELS, 10.0), away) == []


@pytest.mark.parametrize("between", [10.3, 20.0, math.nan])
def test_the_time_begins_anew_where_it_was_elsewhere(between: float) -> None:
    readings = [(float(t), 10.0) for t in range(9)] + [(9.0, between)] + [(10.0 + t, 10.0) for t in range(12)]
    assert reached(LevelDetector(LEVELS, None), readings)[0] == 20.0


def test_without_a_time_a_level_is_held_at_once() -> None:
    assert LevelDetector(replace(LEVELS, for_s=0.0), None).held(3.0, 0.0)


@pytest.mark.parametrize(
    ("labels", "following"),
    [
        (["S00", "S01", "S02", "S03"], "S04"),
        (["S00", "S01", "S01.2", "S01.3"], "S02"),  # which are repeats
        (["S00", "S07", "S03"], "S08"),
        (["S98", "S99"], "S100"),
        (["rest", "load1", "load2"], "load3"),
        (["t0001", "t0002"], "t0003"),
        (["0", "1"], "2"),
        (["rest"], "S01"),
        (["rest", "half", "full"], "S03"),
        (["A00", "A01", "B00"], "B01"),
        (["S00", "s01", "S00.2"], "s02"),
        (["s02", "S01"], "S03"),  # the folders of some disks tell no capitals apart
        (["20260301120000"], "S01"),
    ],
)
def test_one_more_state_is_called_as_the_ones_before(labels: list[str], following: str) -> None:
    assert next_label(labels) == following
