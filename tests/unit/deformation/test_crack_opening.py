"""The jump of a displacement across a crack, on fields that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.metrology.deformation.cracks.opening import CrackOpening, Field, crack_openings

SIZE, RADIUS = 200, 8
ROW, COLUMN = np.mgrid[0:SIZE, 0:SIZE].astype(float)
TURN = np.radians(20.0)
NORMAL = np.array([np.cos(TURN), np.sin(TURN)])
"""Across the crack, as column and row."""
BEFORE = (COLUMN - SIZE / 2) * NORMAL[0] + (ROW - SIZE / 2) * NORMAL[1]
TILT = np.array([0.3, -0.2])
"""Slope of the surface along x and y."""
APART = {1: 1, 2: 1}


def field(jump: tuple[float, float, float], noise: float = 0.0, slope: float = 0.0) -> Field:
    """Return a tilted plane in mm, a tenth of a mm a pixel, of which one half has gone by `jump`."""
    x, y = 0.1 * COLUMN, -0.1 * ROW
    position = np.stack([x, y, TILT[0] * x + TILT[1] * y])
    labels = np.where(BEFORE > 1.5, 2, np.where(BEFORE < -1.5, 1, 0)).astype(np.int32)
    moved = np.array(jump)[:, None, None] * (labels == 2) + slope * position
    moved += noise * np.random.default_rng(5).normal(size=moved.shape)
    covariance = np.zeros((6, SIZE, SIZE))
    covariance[[0, 3, 5]] = max(noise, 1e-6) ** 2
    for values in (moved, position):
        values[:, labels == 0] = np.nan
    return Field(position, moved, covariance, 0.0 * covariance, labels, RADIUS)


def axes() -> np.ndarray:
    """Return across and along the crack and out of the surface, from the region of less area to the other."""
    right, down = (np.array([0.1, 0.0, 0.1 * TILT[0]]), np.array([0.0, -0.1, -0.1 * TILT[1]]))
    along = -right * NORMAL[1] + down * NORMAL[0]
    along /= np.linalg.norm(along)
    out = -np.cross(right, down)
    out /= np.linalg.norm(out)
    across = np.cross(along, out)
    across *= np.sign(across @ (right * NORMAL[0] + down * NORMAL[1]))
    return np.stack([across, along, out])


def measured(of: Field, origin: dict[int, int] = APART) -> CrackOpening:
    (found,) = crack_openings(of, origin, 10)
    return found


def test_a_jump_is_found_across_along_and_out_of_the_surface() -> None:
    """The planes are exact; what is left is the line's direction, by a hundredth of a radian of 0.3 mm."""
    true = np.array([0.3, 0.1, 0.05])
    found = measured(field(tuple(true @ axes()), slope=0.01))
    assert found.sides == (1, 2)
    assert len(found.pixel) > 15
    sign = np.array([1.0, np.sign(found.opening[1].mean()), 1.0])
    np.testing.assert_allclose(
        found.opening, np.broadcast_to((sign * true)[:, None], found.opening.shape), atol=4e-3
    )
    off = np.abs((found.pixel - SIZE / 2) @ NORMAL)
    assert off.max() < 1.0
    np.testing.assert_allclose(found.position[:, 2], found.position[:, :2] @ TILT, atol=1e-9)


def test_sides_that_touch_are_a_closed_crack() -> None:
    closed = field((0.0, 0.0, 0.0))
    found = measured(closed)
    assert np.abs(found.opening).max() < 1e-9


def test_regions_that_were_never_one_have_no_crack() -> None:
    assert not list(crack_openings(field((1.0, 0.0, 0.0)), {1: 1, 2: 2}, 10))


def test_a_side_without_displacement_has_no_points() -> None:
    lost = field((1.0, 0.0, 0.0))
    lost.displacement[:, (lost.labels == 2) & (ROW < SIZE / 2)] = np.nan
    found = measured(lost)
    assert found.pixel[:, 1].min() > SIZE / 2 - 3 * RADIUS


def test_the_error_is_that_of_planes_over_half_a_disc() -> None:
    """Noise that is independent from pixel to pixel is stated as that of subsets: by their width too much."""
    noisy = field((0.0, 0.0, 0.0), noise=0.01)
    independent = replace(
        noisy, subset_radius_px=RADIUS, covariance=noisy.covariance * 1.39 / (2 * RADIUS + 1) ** 2
    )
    found = measured(independent)
    score = found.opening[:2] / found.sigma[:2]
    # Some fifty discs that overlap by two thirds, on both sides: a dozen independent values.
    assert 0.6 < np.sqrt(np.mean(score**2)) < 1.5


@pytest.mark.parametrize("length", [60, 120])
def test_ahead_of_a_tip_the_deviation_holds(length: int) -> None:
    """An opening that begins within the reach of the planes is seen ahead of where it begins."""
    of = field((0.0, 0.0, 0.0))
    along = -(COLUMN - SIZE / 2) * NORMAL[1] + (ROW - SIZE / 2) * NORMAL[0] + SIZE / 2
    opened = 0.2 * np.sqrt(np.maximum(length - along, 0.0) / length)
    of.displacement[:] += np.where(of.labels == 2, opened, 0.0) * axes()[0][:, None, None]
    found = measured(of)
    at = (found.pixel - SIZE / 2) @ np.array([-NORMAL[1], NORMAL[0]]) + SIZE / 2
    true = 0.2 * np.sqrt(np.maximum(length - at, 0.0) / length)
    assert np.max(np.abs(found.opening[0] - true) / found.sigma[0]) < 3.0
    assert np.median(np.abs(found.opening[0] - true)) < 0.005
