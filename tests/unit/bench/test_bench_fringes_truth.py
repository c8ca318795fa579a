"""Figures of what is not as it was told: cases are true, all of them count, and mishaps are what they say."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sms_jobs.bench.figures import Condition, Figure, Run
from sms_jobs.bench.fringes.accepted_cases import ACCEPTED, AcceptedCase
from sms_jobs.bench.fringes.bent_waveforms import record
from sms_jobs.bench.fringes.broken_models import CASES, rms
from sms_jobs.bench.fringes.code_mishaps import CODED, code_mishaps, coded_session
from sms_jobs.bench.groups.fringes_truth import judged_cases
from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.measurement import FringeSequence


@cache
def judged(name: str) -> tuple[Floats, float]:
    (found,) = (one for one in ACCEPTED if one.name == name)
    return found.judged(np.random.default_rng(3))


@pytest.mark.parametrize("name", ["silhouettes, unwrapping", "8 bits, three steps", "8 bits, four steps"])
def test_errors_of_a_case_are_what_is_stated(name: str) -> None:
    z, valid = judged(name)
    assert valid > 0.3
    # A model that is right has 1; the group's limit for one that is not is 1.3.
    assert 0.85 < rms(z) < 1.15
    assert not np.any(z > 10.0)


def test_mixed_pixels_are_some_of_the_silhouettes() -> None:
    every, part = judged("silhouettes, unwrapping")
    mixed, same = judged("mixed pixels, unwrapping")
    assert part == same
    assert 0 < mixed.size < 0.1 * every.size
    assert np.isin(mixed, every).all()


def test_mishaps_that_are_slight_are_accepted() -> None:
    z, valid = judged("slight mishaps")
    assert valid > 0.3
    assert z.size > 1000
    assert not np.any(z > 10.0)


def test_eight_bits_have_their_full_scale() -> None:
    sequence = FringeSequence((8, 7), 3)
    seen = record(np.random.default_rng(1), sequence, 1.0, 0.01, twice=False, full_scale=255)
    assert seen.measurement.full_scale == 255
    assert 50 < seen.measurement.frames.rows(0, 10).max() <= 255
    # A hundredth of full scale, and rounding.
    assert seen.measurement.read_noise == pytest.approx(np.hypot(2.55, 12.0**-0.5))


def test_each_mishap_of_a_code_changes_what_is_told_or_recorded() -> None:
    random = np.random.default_rng(8)
    session = coded_session(random, CODED[1], plain=True)
    right = session.measurement
    names = set()
    for mishap in code_mishaps(session, random):
        names.add(mishap.name)
        frames = mishap.measurement.frames.rows(0, 128)
        same = np.array_equal(frames, right.frames.rows(0, 128))
        assert not same or mishap.measurement.sequence != right.sequence, mishap.name
        assert frames.shape == right.frames.rows(0, 128).shape
        assert frames.dtype == right.frames.dtype
    assert len(names) == 15


def test_one_seed_draws_one_session() -> None:
    one, same, other = (coded_session(np.random.default_rng(s)).measurement for s in (2, 2, 3))
    np.testing.assert_array_equal(one.frames.rows(0, 128), same.frames.rows(0, 128))
    assert not np.array_equal(one.frames.rows(0, 128), other.frames.rows(0, 128))


def test_the_worst_case_is_of_all_cases(tmp_path: Path) -> None:
    def far_off(random: np.random.Generator) -> tuple[Floats, float]:
        return random.normal(0.0, 20.0, 1000), 0.5

    cases = (CASES[4], AcceptedCase("far off", far_off), ACCEPTED[5])
    found = list(judged_cases(Run(True, lambda said: None, 1, tmp_path), 7, cases))
    figures = {one.name: one.value for one in found if isinstance(one, Figure)}
    # Of two times 1000 normal numbers with 20 the root mean square is good to 20 / sqrt(4000) = 0.32.
    assert figures["worst_z"] == pytest.approx(20.0, abs=1.5)
    assert figures["beyond_10_sigma_per_million"] > 100.0
    (condition,) = (one for one in found if isinstance(one, Condition))
    assert "the worst is far off" in condition.text
    assert all(name in condition.text for name in (CASES[4].name, ACCEPTED[5].name))
