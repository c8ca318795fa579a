"""Three ways to the end of a displacement: all are right, and the study says by how much."""

from __future__ import annotations

from sms_jobs.bench.studies.stereo_strategies import WAYS, compared, motions


def test_all_ways_find_a_small_shift() -> None:
    name = "shift by 0.3 px"
    both = [
        compared(lambda text: None, 400, lambda px_mm: {name: motions(px_mm)[name]}, seed=seed)[name]
        for seed in (0, 1)
    ]
    for judged in both:
        assert set(judged) == set(WAYS)
        # A pixel is 0.45 mm, depth known less well by the sine of 20 degrees: 0.015 px of a match are 20 um.
        assert all(one.rms < 20.0 for one in judged.values())
        # The same texture seen by the same camera is matched better than by another.
        assert judged["own-reference"].median < judged["each-state"].median
        assert all(one.valid > 0.4 for one in judged.values())
        # Some 130 subsets do not overlap: by chance alone the mean of one recording is 0.09 of the rms.
        assert all(one.bias < 0.2 * one.rms for one in judged.values())
