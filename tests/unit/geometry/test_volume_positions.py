"""Positions of a test lie within the volume, and go all over it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.volume_positions import bar_positions, plane_positions

LOW, HIGH = (-130.0, -120.0, -100.0), (130.0, 140.0, 110.0)
MIDDLE = np.array([0.0, 10.0, 5.0])


def test_a_bar_stays_inside_with_its_spheres_and_goes_all_over() -> None:
    found = bar_positions(LOW, HIGH, 150.0, 22.0)
    assert [one.label for one in found] == [f"B{k:02d}" for k in range(1, 8)]
    ends = []
    for one in found:
        half = Rotation.from_rotvec(one.rotation_rad).apply([0.0, 0.0, 75.0])
        for centre in (np.array(one.middle_mm) - half, np.array(one.middle_mm) + half):
            assert (centre - 22.0 >= np.array(LOW) - 1e-9).all()
            assert (centre + 22.0 <= np.array(HIGH) + 1e-9).all()
            ends.append(centre)
    spread = np.ptp(ends, axis=0) / np.subtract(HIGH, LOW)
    assert (spread > [0.5, 0.5, 0.4]).all()
    along = Rotation.from_rotvec(found[0].rotation_rad).apply([0.0, 0.0, 1.0])
    assert along == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)


def test_a_plate_stays_inside_and_faces_the_cameras() -> None:
    towards = np.array([200.0, 100.0, 1200.0])
    found = plane_positions(LOW, HIGH, 120.0, 100.0, towards)
    facing = (towards - MIDDLE) / np.linalg.norm(towards - MIDDLE)
    for one in found:
        turn = Rotation.from_rotvec(one.rotation_rad)
        corners = turn.apply([[a * 60.0, b * 50.0, 0.0] for a in (-1, 1) for b in (-1, 1)]) + one.middle_mm
        assert (corners >= np.array(LOW) - 1e-9).all()
        assert (corners <= np.array(HIGH) + 1e-9).all()
        cosine = turn.apply([0.0, 0.0, 1.0]) @ facing
        assert cosine == pytest.approx(1.0 if "facing" in one.words else np.cos(np.radians(20.0)), abs=1e-9)
    apart = np.subtract(found[1].middle_mm, found[2].middle_mm)
    assert apart @ facing > 20.0


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(InvalidInput, match="does not fit along X, in the middle in a volume of 260 x 260 x"):
        bar_positions(LOW, HIGH, 230.0, 22.0)
    with pytest.raises(InvalidInput, match="a plate of 300 x 100 mm does not fit facing"):
        plane_positions(LOW, HIGH, 300.0, 100.0, np.array([0.0, 0.0, 1000.0]))
