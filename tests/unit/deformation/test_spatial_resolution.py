"""Spatial resolution: what each step leaves of a wave is what theory says, and what is stated is measured."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, special

from sms_jobs.bench.correlated import star
from sms_jobs.bench.correlated.lone_camera import DEFORMED, correlated
from sms_jobs.bench.correlated.speckle_pairs import speckle_pair
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.metrology.deformation.fields.averaging import average_in_region
from sms_jobs.metrology.deformation.fields.displacement import ImagePoints, blend_matches
from sms_jobs.metrology.deformation.fields.spatial_resolution import (
    left_by_averaging,
    left_by_blending,
    left_by_gauge,
    periods_about,
    pixel_extent,
    resolution_of,
    response_of_subsets,
    strain_resolution,
)
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.deformation.strain.tangent_plane import surface_strain

SIZE = 161
ONE = np.ones((SIZE, SIZE), np.int32)
Y, X = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
PLANE = np.stack([X, Y, 0.0 * X])


@pytest.mark.parametrize("order", [0, 1, 2])
def test_a_subset_is_the_filter_of_savitzky_and_golay(order: ShapeOrder) -> None:
    periods = periods_about(9)
    found = response_of_subsets(9, order, periods)
    # The same filter over the square, summed across the wave; rounding only.
    assert found.value == pytest.approx(star.transfer(19, order, periods), abs=1e-12)
    # Of a wave 12 times as long as the subset it has slope and curvature, but for 0.1 and 0.2 of z^2 = 0.07.
    wave = 2.0 * np.pi / periods[-1]
    assert found.slope[-1] == pytest.approx(wave if order > 0 else 0.0, rel=0.01)
    assert found.bend[-1] == pytest.approx(-(wave**2) if order > 1 else 0.0, rel=0.02)


@pytest.mark.parametrize(("order", "spacing"), [(1, 4), (1, 9), (2, 5)])
def test_what_is_left_of_a_wave_is_what_blending_leaves(order: ShapeOrder, spacing: int) -> None:
    radius, periods = 12, np.array([25.0, 40.0, 61.0])
    found = response_of_subsets(radius, order, periods)
    left = left_by_blending(found, radius, 12 if order > 1 else 6, spacing)
    y, x = (a.ravel() for a in np.mgrid[2:SIZE:spacing, 2:SIZE:spacing])
    inner = np.s_[40:-40, 40:-40]
    for k, period in enumerate(periods):
        wave = 2.0 * np.pi / period
        warp = np.zeros((len(x), 12 if order > 1 else 6))
        warp[:, 0], warp[:, 1] = found.value[k] * np.cos(wave * x), -found.slope[k] * np.sin(wave * x)
        if order > 1:
            warp[:, 6] = found.bend[k] * np.cos(wave * x)
        points = ImagePoints(x, y, np.ones(len(x), np.int32), warp, np.full((len(x), 2), 0.01))
        value = blend_matches(points, PLANE, ONE, radius).value[0][inner].mean(axis=0)
        basis = np.stack([np.cos(wave * X[0, 40:-40]), np.sin(wave * X[0, 40:-40])], axis=1)
        # 81 columns are no whole number of periods, nor of spacings: what is no wave leaks in by a hundredth.
        assert np.linalg.lstsq(basis, value, rcond=None)[0][0] == pytest.approx(left[k], abs=0.01)


def test_what_is_left_of_a_wave_is_what_averaging_leaves() -> None:
    wave = np.stack([np.cos(2.0 * np.pi * (X - 80.0) / 17.0)] * 3)
    covariance = np.zeros((6, SIZE, SIZE))
    covariance[[0, 3, 5]] = 1.0
    value, _ = average_in_region(wave, covariance, ONE, ONE > 0, 6.0)
    # A disc of 6 px has 113 pixels: the integral over it is right to a hundredth of what is lost, 0.27.
    assert value[0, 80, 80] == pytest.approx(left_by_averaging(6.0, np.array([17.0]))[0], abs=3e-3)
    assert left_by_averaging(0.0, np.array([5.0]))[0] == 1.0


@pytest.mark.parametrize("ratio", [0.9, 1.5, 3.0])
def test_what_is_left_of_strain_is_what_the_gauge_leaves(ratio: float) -> None:
    gauge = 50.0
    wave = 2.0 * np.pi / (ratio * gauge)
    moved = np.stack([1e-4 * np.sin(wave * (X - 80.0)) / wave, 0.0 * X, 0.0 * X])
    nothing = np.zeros((6, SIZE, SIZE))
    found = surface_strain(PLANE, moved, nothing, ONE, gauge_length=gauge, green_lagrange=False)
    # The disc is made of squares of 3 px, 1/16 of its diameter: their means and its outline are off by a
    # hundredth, of an amplitude of 1e-4.
    expected = left_by_gauge(np.array([ratio]))[0]
    assert found.strain[0, 80, 80] == pytest.approx(1e-4 * expected, abs=1.5e-6)


def test_the_resolution_of_strain_is_of_gauge_and_displacement() -> None:
    alone = optimize.brentq(lambda z: 8.0 * special.jv(2, z) / z**2 - 0.9, 0.5, 2.0)
    found = strain_resolution(np.array([0.0, 1.0, 50.0, 5000.0, np.nan]), 20.0)
    # Between the periods of the table, 1.2 % apart, a line is right to 1e-4.
    assert found[0] == pytest.approx(20.0 * np.pi / alone, rel=1e-3)
    assert found[1] == pytest.approx(found[0], rel=1e-3)
    period = found[2]
    left = left_by_gauge(np.array([period / 20.0]))[0] * (1.0 - 0.1 * (50.0 / period) ** 4)
    assert left == pytest.approx(0.9, abs=2e-3)
    assert found[3] == pytest.approx(5000.0, rel=1e-3)
    assert np.isnan(found[4])


def test_no_resolution_is_told_beyond_what_was_looked_at() -> None:
    periods = np.array([10.0, 20.0, 30.0])
    assert resolution_of(periods, np.array([0.95, 0.8, 1.0])) == pytest.approx(25.0)
    assert resolution_of(periods, np.array([0.95, 0.99, 1.0])) == 10.0
    assert np.isnan(resolution_of(periods, np.array([0.95, 1.0, 0.8])))
    assert np.isnan(resolution_of(periods, np.array([0.95, 1.0, np.nan])))


def test_what_a_pixel_covers_is_taken_where_it_covers_most() -> None:
    tilted = np.stack([0.5 * X, -0.5 * Y, 0.3 * X + 0.4 * Y])
    labels = np.where(X < 70.0, 1, 2).astype(np.int32)
    tilted[2] += np.where(X < 70.0, 0.0, 30.0)
    tilted[:, :20, :30] = np.nan
    labels[100:, :50] = 0
    found = pixel_extent(tilted, labels, 4)
    # The gradient of height is 0.5 a pixel, half a pixel's size being 0.5: sqrt(0.5^2 + 0.5^2); exact.
    known = np.isfinite(tilted[0]) & (labels > 0)
    np.testing.assert_allclose(found[known], np.hypot(0.5, 0.5), rtol=1e-9)
    assert np.isnan(found[120, 20])


@pytest.mark.parametrize("order", [1, 2])
def test_nine_tenths_are_left_of_a_wave_of_the_stated_period(order: int, rng: np.random.Generator) -> None:
    parameters, amplitude = CorrelateParameters(shape_order=order), 0.05
    still = speckle_pair((192, 320), lambda x, y: (0.0 * x, 0.0 * y), 5)[0]

    def recorded(light: np.ndarray) -> np.ndarray:
        return np.rint(light + rng.normal(0.0, 4.0, light.shape)).astype(np.uint16)

    reference = recorded(still)
    at_rest = correlated(reference, recorded(still), 4.0, parameters, 1).records["correlate", DEFORMED]
    period = at_rest["displacement"].resolution_px
    wave = 2.0 * np.pi / period
    moved = speckle_pair((192, 320), lambda x, y: (amplitude * np.cos(wave * x), 0.0 * y), 5)[1]
    found = correlated(reference, recorded(moved), 4.0, parameters, 1).records["correlate", DEFORMED]
    field = found["displacement"]
    valid = field.reason == 0
    assert np.isnan(field.resolution[~valid]).all()
    assert (field.resolution[valid] == np.float32(field.resolution_px)).all()
    # 26 px from the border no subset is cut that has a part in a pixel.
    inner = np.s_[30:-30, 30:-30]
    at = np.arange(30, 290) * wave
    basis = np.stack([np.cos(at), np.sin(at), np.ones_like(at)], axis=1)
    u = np.nanmean(field.image_displacement[0][inner], axis=0)
    kept = np.linalg.lstsq(basis, u, rcond=None)[0][0] / amplitude
    # The 130 subsets side by side that this is a mean of scatter in what they find of a wave by a tenth, as
    # speckle has it: 0.01; the iteration may leave 0.0005 px, 0.01 of the amplitude, and noise adds 0.005.
    assert kept == pytest.approx(0.9, abs=0.03)
