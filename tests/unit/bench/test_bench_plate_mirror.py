"""The plate and mirror that benchmark and study measure: which pixels are lit how often, and the plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.bench.fringes import plate_mirror
from sms_jobs.bench.fringes.plate_mirror import Plate, only, record, rms_off
from sms_jobs.kinds.shape.reconstruct import ReconstructParameters
from sms_jobs.records.fields import Surface
from sms_jobs.virtual_rig.light import trace


@pytest.fixture(scope="module")
def plate() -> Plate:
    return record("small", 4, 2)


def test_pixels_are_lit_once_or_twice_and_never_both(plate: Plate) -> None:
    assert plate.once.sum() > 10_000
    assert plate.twice.sum() > 10_000
    assert not (plate.once & plate.twice).any()
    simulation = plate.measurement.simulation
    assert simulation is not None
    strength = trace(simulation, 2).strength[:, ::2, ::2]
    assert (strength[0][plate.once | plate.twice] > 0.0).all()
    assert (strength[1][plate.twice] > 0.0).all()
    assert (strength[1][plate.once] == 0.0).all()


def test_some_of_the_densities_are_the_frames_of_those(plate: Plate) -> None:
    part = only(plate, (3, 1)).measurement
    assert part.sequence.frames == part.frames.shape[0] == 16
    old, new = list(plate.measurement.sequence.patterns()), list(part.sequence.patterns())
    for index, pattern in enumerate(new):
        np.testing.assert_array_equal(
            part.frames.frame(index), plate.measurement.frames.frame(old.index(pattern))
        )


def test_the_plane_is_that_of_what_is_lit_once(plate: Plate) -> None:
    rows, columns = plate.once.shape
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float64)
    xyz = np.stack([x, y, 0.2 * x - 0.1 * y + 5.0])
    xyz[2, plate.twice] += 0.3 * np.sqrt(1.0 + 0.2**2 + 0.1**2)  # 0.3 along the normal
    none = np.zeros((6, rows, columns), np.float32)
    cloud = Surface("C1P1", "mm", xyz, np.zeros((rows, columns), np.uint32), none, none[0])
    off = plate.off_plane(cloud)
    assert rms_off(off, plate.once)[0] < 1e-9
    assert rms_off(off, plate.twice) == (pytest.approx(0.3), 1.0)
    assert np.isnan(off[~(plate.once | plate.twice)]).all()
    tensor = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -1.0], [0.5, -1.0, 2.0]])
    packed = tensor[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)
    noisy = replace(cloud, covariance=np.broadcast_to(packed[:, None, None], none.shape))
    normal = np.array([-0.2, 0.1, 1.0]) / np.sqrt(1.0 + 0.2**2 + 0.1**2)
    stated = plate.off_plane_sigma(noisy)[plate.once]
    np.testing.assert_allclose(stated, np.sqrt(normal @ tensor @ normal), rtol=1e-6)
    half = replace(cloud, reason=np.where(plate.twice & (x % 2 == 0), 4, 0).astype(np.uint32))
    half.position[:, half.reason > 0] = np.nan
    assert rms_off(plate.off_plane(half), plate.twice)[1] == pytest.approx(0.5, abs=0.01)


def test_the_masks_that_are_lifted_exist() -> None:
    lifted = ReconstructParameters(**plate_mirror.UNMASKED)  # type: ignore[arg-type]
    usual = ReconstructParameters()
    assert [name for name in plate_mirror.UNMASKED if getattr(lifted, name) == getattr(usual, name)] == []
