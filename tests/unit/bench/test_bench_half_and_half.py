"""The half-and-half subset: regions end the error at the edge, and the study says so."""

from __future__ import annotations

import numpy as np

from sms_jobs.bench.correlated.half_and_half import match_halves
from sms_jobs.bench.studies.half_and_half import by_distance

SHIFTS = ((0.4, 0.8), (1.2, 2.4))
RADIUS = 10


def test_regions_hold_to_the_edge_and_plain_matching_does_not() -> None:
    parted = match_halves(parted=True, radius=RADIUS, shifts=SHIFTS)
    plain = match_halves(parted=False, radius=RADIUS, shifts=SHIFTS)
    near = np.abs(parted.distance) < RADIUS
    # The required 0.01 px: half a subset has twice the whole one's error, which is the spline's.
    assert parted.rms()[near].max() < 0.01
    assert (parted.found() > 0.98).all()
    # Half of the subset moves by half a pixel to a pixel more.
    assert plain.rms()[near].max() > 0.1
    # Beyond the subset both see the same pixels.
    far = np.abs(parted.distance) > RADIUS + 1
    np.testing.assert_allclose(plain.rms()[far], parted.rms()[far], rtol=1e-9)
    assert parted.own_part[near].min() == 11.0 / 21.0
    assert (parted.own_part[far] == 1.0).all()


def test_both_sides_are_taken_together() -> None:
    found = match_halves(parted=True, radius=RADIUS, shifts=SHIFTS[:1], noise=0.02)
    rms, part = by_distance(found)
    assert len(rms) == len(found.distance) // 2
    half = len(rms)
    squares = found.error[0, half - 1] ** 2, found.error[0, half] ** 2
    np.testing.assert_allclose(rms[0], np.sqrt(np.nanmean(np.concatenate(squares))))
    assert (part <= 1.0).all()
