"""Three ways to the end of a displacement: all are right, and the study says by how much."""

from __future__ import annotations

from sms_jobs.bench.studies.stereo_strategies import WAYS, compared, motions


def test_all_ways_find_a_small_shift() -> None:
    found = compared(
        lambda text: None, 400, lambda px_mm: {"shift by 0.3 px": motions(px_mm)["shift by 0.3 px"]}
    )
    judged = found["shift by 0.3 px"]
    assert set(judged) == set(WAYS)
    # A pixel is 0.45 mm, depth is known less well by the sine of 20 degrees: 0.015 px of a match are 20 um.
    assert all(one.rms < 20.0 and one.bias < 0.2 * one.rms for one in judged.values())
    # The same texture seen by the same camera is matched better than by another.
    assert judged["own-reference"].median < judged["each-state"].median
    assert all(one.valid > 0.4 for one in judged.values())
