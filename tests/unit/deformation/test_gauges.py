"""Virtual gauges on fields whose strain is known, and profiles along lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.metrology.deformation.strain.gauges import GaugePlace, profile_along, read_gauge

ROWS, COLUMNS, PITCH = 60, 80, 0.5
ONE = np.ones((ROWS, COLUMNS), dtype=np.int32)
NONE = np.zeros((6, ROWS, COLUMNS))
GRADIENT = np.array([[2e-3, 1e-3, 0.0], [-4e-4, -1e-3, 0.0], [3e-3, 2e-3, 0.0]])


def tilted() -> np.ndarray:
    """Return a tilted plane, x to the right and y up, in mm."""
    row, column = np.mgrid[0:ROWS, 0:COLUMNS]
    x, y = PITCH * (column - COLUMNS / 2), -PITCH * (row - ROWS / 2)
    return np.stack([x, y, 0.4 * x - 0.2 * y])


@pytest.mark.parametrize("angle", [0.0, 0.7, np.pi / 2])
@pytest.mark.parametrize("green", [True, False])
def test_a_gauge_reads_the_strain_along_its_direction(angle: float, green: bool) -> None:
    xyz = tilted()
    moved = np.einsum("ij,jrc->irc", GRADIENT, xyz)
    place = GaugePlace(3.0, -4.0, 8.0, 4.0, angle)
    found = read_gauge(place, xyz, moved, NONE, ONE, green_lagrange=green)
    normal = np.array([-0.4, 0.2, 1.0]) / np.linalg.norm([-0.4, 0.2, 1.0])
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    along -= normal * (normal @ along)
    along /= np.linalg.norm(along)
    slope = GRADIENT @ along
    expected = along @ slope + (0.5 * slope @ slope if green else 0.0)
    # An affine field on a plane is fitted exactly, but for rounding.
    assert found.strain == pytest.approx(expected, abs=1e-12)
    assert found.sigma == 0.0
    # The pixel nearest to its place: half a pitch each way at most.
    np.testing.assert_allclose(found.middle[:2], [3.0, -4.0], atol=0.5 * PITCH)


def test_the_scatter_of_a_gauge_is_the_one_stated(rng: np.random.Generator) -> None:
    xyz = tilted()
    noise = np.zeros((6, ROWS, COLUMNS))
    noise[[0, 3, 5]] = 1e-6
    place = GaugePlace(0.0, 0.0, 10.0, 5.0, 0.3)
    found = [
        read_gauge(place, xyz, rng.normal(0.0, 1e-3, xyz.shape), noise, ONE, green_lagrange=False)
        for _ in range(300)
    ]
    # 300 values: their standard deviation scatters by 1 / sqrt(600) = 4 %.
    assert np.std([f.strain for f in found]) / found[0].sigma == pytest.approx(1.0, abs=0.13)


def test_a_gauge_off_the_surface_or_across_regions_reads_nothing_false() -> None:
    xyz = tilted()
    moved = np.einsum("ij,jrc->irc", GRADIENT, xyz)
    place = GaugePlace(0.0, 0.0, 8.0, 4.0)
    assert np.isnan(read_gauge(replace(place, x=40.0), xyz, moved, NONE, ONE).strain)
    assert np.isnan(read_gauge(place, xyz, moved * np.nan, NONE, ONE).strain)
    labels = ONE.copy()
    labels[:, COLUMNS // 2 + 2 :] = 2
    jump = moved + np.where(labels == 2, 5.0, 0.0)
    alone = read_gauge(place, xyz, jump, NONE, labels)
    whole = read_gauge(place, xyz, moved, NONE, ONE)
    assert alone.strain == pytest.approx(whole.strain, abs=1e-12)
    assert alone.pixels < whole.pixels


def test_a_profile_of_a_linear_field_is_the_field() -> None:
    xyz = tilted()
    field = np.stack([xyz[0] + 2.0 * xyz[1], 3.0 - xyz[0]])
    field[:, 30:34, 40:44] = np.nan
    found = profile_along(xyz, field, (-15.0, -6.0), (15.0, 8.0), step_mm=2.0, width_mm=3.0)
    known = found.pixels > 0
    x, y, _ = found.position[known].T
    # Means of a linear field are its values at mean places.
    np.testing.assert_allclose(found.value[:, known], [x + 2.0 * y, 3.0 - x], atol=1e-12)
    assert known.all()
    assert found.distance[-1] == pytest.approx(np.hypot(30.0, 14.0) - 1.0, abs=0.1)
    # A strip of 33 mm x 3 mm holds 4 pixels a square millimetre, less 16 without a value.
    assert found.pixels.sum() == pytest.approx(33.1 * 3.0 * 4.0 - 16.0, rel=0.05)
