"""Strain of known deformations, on planes and curved surfaces, and its standard deviation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.deformation.fields.averaging import average_in_region
from sms_jobs.metrology.deformation.strain.strain_errors import shared_errors
from sms_jobs.metrology.deformation.strain.tangent_plane import surface_strain

ROWS, COLUMNS, PITCH = 60, 64, 0.5
NONE = np.zeros((6, ROWS, COLUMNS))
ALL = np.ones((ROWS, COLUMNS), np.int32)


def plane(tilt: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Return a plane seen from +Z, in mm: x to the right, y up."""
    row, column = np.mgrid[0:ROWS, 0:COLUMNS]
    x, y = PITCH * (column - COLUMNS / 2), -PITCH * (row - ROWS / 2)
    return np.stack([x, y, tilt[0] * x + tilt[1] * y])


def cylinder(radius: float = 40.0) -> np.ndarray:
    """Return part of a cylinder about y, evenly spaced along its arc."""
    x, y, _ = plane()
    return np.stack([radius * np.sin(x / radius), y, radius * (np.cos(x / radius) - 1.0)])


def carried(matrix: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return np.einsum("ij,jrc->irc", matrix, xyz)


def test_uniform_strain_of_a_plane_is_exact_in_any_frame() -> None:
    xyz = plane((0.4, -0.2))
    gradient = np.array([[2e-3, 1e-3, 0.0], [-4e-4, -1e-3, 5e-4], [3e-3, 0.0, 1e-3]])
    axis = np.array([0.8, 0.6, 0.0])
    found = surface_strain(xyz, carried(gradient, xyz), NONE, ALL, gauge_length=6.0, x_axis=(0.8, 0.6, 0.0))
    normal = np.array([-0.4, 0.2, 1.0]) / np.linalg.norm([-0.4, 0.2, 1.0])
    x = axis - normal * (normal @ axis)
    frame = np.stack([x / np.linalg.norm(x), np.cross(normal, x / np.linalg.norm(x))], axis=1)
    stretched = (np.eye(3) + gradient) @ frame
    e = 0.5 * (stretched.T @ stretched - np.eye(2))
    expected = np.array([e[0, 0], e[1, 1], e[0, 1]])
    # A linear displacement on a plane is fitted exactly: rounding of 10^-16 mm over the disc's 6 mm.
    np.testing.assert_allclose(found.strain, np.tile(expected[:, None, None], (1, ROWS, COLUMNS)), atol=1e-13)
    values = np.linalg.eigvalsh(e)[::-1]
    np.testing.assert_allclose(found.principal[:, 30, 30], values, atol=1e-13)
    assert found.von_mises[30, 30] == pytest.approx(
        np.sqrt(values[0] ** 2 - values[0] * values[1] + values[1] ** 2)
    )
    small = surface_strain(
        xyz,
        carried(gradient, xyz),
        NONE,
        ALL,
        gauge_length=6.0,
        x_axis=(0.8, 0.6, 0.0),
        green_lagrange=False,
    )
    linear = frame.T @ (0.5 * (gradient + gradient.T)) @ frame
    np.testing.assert_allclose(
        small.strain[:, 30, 30], [linear[0, 0], linear[1, 1], linear[0, 1]], atol=1e-13
    )


@pytest.mark.parametrize("surface", [plane((0.3, 0.1)), cylinder()], ids=["plane", "cylinder"])
def test_a_rigid_motion_is_no_strain(surface: np.ndarray) -> None:
    turn = Rotation.from_rotvec([0.2, -0.3, 0.5]).as_matrix() - np.eye(3)
    moved = carried(turn, surface) + np.array([3.0, -2.0, 1.0])[:, None, None]
    labels = ALL.copy()
    labels[:, :7] = 0
    labels[20:30, 30:45] = 0
    found = surface_strain(surface, moved, NONE, labels, gauge_length=8.0)
    # Exact even at the edges, see the function's notes; rounding of 3 mm over 8 mm.
    assert np.nanmax(np.abs(found.strain)) < 1e-13
    assert np.isfinite(found.strain[0]).sum() == (labels > 0).sum()
    small = surface_strain(surface, moved, NONE, labels, gauge_length=8.0, green_lagrange=False)
    assert np.nanmax(np.abs(small.strain)) > 0.01  # small strain is not meant for rotations


def test_a_stretched_cylinder_has_hoop_and_axial_strain() -> None:
    xyz = cylinder()
    swollen = 1e-3 * (xyz + np.array([0.0, 0.0, 40.0])[:, None, None])
    swollen[1] = -3e-4 * xyz[1]
    found = surface_strain(xyz, swollen, NONE, ALL, gauge_length=4.0)
    inner = np.s_[10:-10, 10:-10]
    # Chords instead of arcs: (gauge / radius)^2 / 32 of the strain, 3 x 10^-7; quadratic terms 10^-3 of it.
    np.testing.assert_allclose(found.strain[0][inner], 1e-3 + 0.5e-6, atol=2e-6)
    np.testing.assert_allclose(found.strain[1][inner], -3e-4 + 0.45e-7, atol=1e-9)
    np.testing.assert_allclose(found.strain[2][inner], 0.0, atol=1e-9)


def test_regions_do_not_strain_each_other() -> None:
    xyz = plane()
    labels = ALL.copy()
    labels[:, 32:] = 2
    moved = np.where(labels == 2, 5.0, 0.0) * np.ones((3, 1, 1))
    found = surface_strain(xyz, moved, NONE, labels, gauge_length=8.0)
    assert np.abs(found.strain).max() < 1e-12
    joined = surface_strain(xyz, moved, NONE, ALL, gauge_length=8.0)
    assert np.abs(joined.strain).max() > 0.5


def test_strain_does_not_reach_across_a_fold() -> None:
    # A roof: one side stands still, the other is stretched by 0.2 % down its slope and turned about it.
    flat = plane()
    column = np.broadcast_to(np.arange(COLUMNS), (ROWS, COLUMNS))
    right = column >= COLUMNS // 2
    x, y, _ = flat
    slope = np.array([np.cos(1.0), 0.0, -np.sin(1.0)])
    xyz = np.where(right, slope[:, None, None] * x + np.array([0.0, 1.0, 0.0])[:, None, None] * y, flat)
    turned = Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix()
    moved = np.where(right, carried(turned, xyz + 2e-3 * slope[:, None, None] * x) - xyz, 0.0)
    expected = np.where(right, 2e-3 + 0.5 * 2e-3**2, 0.0)
    error = {
        angle: np.abs(
            surface_strain(xyz, moved, NONE, ALL, gauge_length=8.0, fold_angle_rad=angle).strain[0] - expected
        )
        for angle in (np.pi, 0.35)
    }
    # Squares of pixels on the ridge belong to both sides, and so do the steps to their neighbours.
    near = np.abs(column - COLUMNS // 2) <= 3
    assert error[0.35][~near].max() < 1e-12
    assert error[np.pi][~near].max() > 1e-4


def test_missing_displacement_and_lonely_points_have_no_strain() -> None:
    xyz = plane()
    moved = 1e-3 * xyz
    moved[:, 20:40, 20:40] = np.nan
    labels = ALL.copy()
    labels[50:, :] = 0
    labels[55, 10:14] = 3
    found = surface_strain(xyz, moved, NONE, labels, gauge_length=5.0)
    assert np.isnan(found.strain[0, 20:40, 20:40]).all()
    assert np.isnan(found.strain[0, 55, 10:14]).all()
    assert np.isfinite(found.strain[0, :20]).all()
    nothing = surface_strain(xyz, np.full_like(xyz, np.nan), NONE, ALL, gauge_length=5.0)
    assert np.isnan(nothing.strain).all()


@pytest.mark.parametrize("gauge_mm", [8.0, 20.0], ids=["every pixel", "means of squares"])
def test_scatter_is_as_predicted(rng: np.random.Generator, gauge_mm: float) -> None:
    xyz = plane((0.5, 0.0))
    sigma = np.array([0.004, 0.002, 0.01])
    covariance = NONE.copy()
    covariance[[0, 3, 5]] = (sigma**2)[:, None, None]
    moved = 0.05 * np.stack([xyz[0], np.zeros_like(xyz[0]), xyz[1]])
    trials = []
    for _ in range(40):
        noise = sigma[:, None, None] * rng.normal(size=xyz.shape)
        found = surface_strain(xyz, moved + noise, covariance, ALL, gauge_length=gauge_mm)
        trials.append(found.strain)
    ratio = np.std(trials, axis=0)[:, 5:-5:8, 5:-5:8] / found.sigma[:, 5:-5:8, 5:-5:8]
    # 40 trials at a dozen or more independent places: 3 %, 10 % for the larger gauge.
    np.testing.assert_allclose(np.sqrt(np.mean(ratio**2, axis=(1, 2))), 1.0, atol=0.15)


@pytest.mark.parametrize("gauge_mm", [5.0, 12.0])
def test_averaged_noise_is_seen_through_its_filter(rng: np.random.Generator, gauge_mm: float) -> None:
    """Averaging displacement lowers its variance, not the noise of long wavelength that strain sees."""
    xyz, radius = plane(), 3.0
    cloud = NONE.copy()
    cloud[[0, 3, 5]] = 0.5 * 0.004**2  # of each state; their difference has 0.004 mm
    trials, averaged = [], NONE
    for _ in range(40):
        raw = 0.004 * rng.normal(size=xyz.shape)
        moved, averaged = average_in_region(raw, 2.0 * cloud, ALL, ALL > 0, radius)
        trials.append(surface_strain(xyz, moved, averaged, ALL, gauge_length=gauge_mm).strain)
    equivalent = shared_errors(
        averaged,
        cloud,
        averaging_radius_px=radius,
        subset_radius_px=0.0,
        disc_radius_px=0.5 * gauge_mm / PITCH,
    )
    sigma = surface_strain(xyz, moved, equivalent, ALL, gauge_length=gauge_mm).sigma
    inner = np.s_[:, 14:-14:6, 14:-14:6]
    ratio = np.sqrt(np.mean(np.var(trials, axis=0)[inner] / sigma[inner] ** 2, axis=(1, 2)))
    # The required 20 %: 5 % for 40 trials at a few independent places, 10 % for the fitted factor.
    np.testing.assert_allclose(ratio, 1.0, atol=0.2)


def test_independent_errors_stay_as_they_are(rng: np.random.Generator) -> None:
    covariance = rng.random((6, 4, 4))
    same = shared_errors(
        covariance, covariance, averaging_radius_px=0.0, subset_radius_px=0, disc_radius_px=9.0
    )
    np.testing.assert_array_equal(same.every, covariance)


def test_a_bias_is_counted_as_one_error_of_the_whole_gauge() -> None:
    """A displacement that errs by a slow sine: no mean over the gauge's pixels makes that smaller."""
    xyz, gauge_mm, amplitude = plane(), 12.0, 0.01
    wrong = np.zeros_like(xyz)
    wrong[0] = amplitude * np.sin(np.pi * xyz[0] / (2.0 * gauge_mm))
    biased = NONE.copy()
    biased[0] = np.mean(wrong[0] ** 2)
    equivalent = shared_errors(
        biased,
        NONE,
        biased,
        averaging_radius_px=0.0,
        subset_radius_px=0,
        disc_radius_px=0.5 * gauge_mm / PITCH,
    )
    found = surface_strain(xyz, wrong, equivalent, ALL, gauge_length=gauge_mm, green_lagrange=False)
    inner = np.s_[14:-14, 14:-14]
    observed = np.sqrt(np.mean(found.strain[0][inner] ** 2))
    # Half of the worst shape is counted; a slow sine is less steep than that.
    assert 0.5 < observed / np.mean(found.sigma[0][inner]) < 1.3


def test_threads_do_not_matter(rng: np.random.Generator) -> None:
    xyz, moved = cylinder(), rng.normal(size=(3, ROWS, COLUMNS))
    one = surface_strain(xyz, moved, NONE + 1.0, ALL, gauge_length=6.0, threads=1)
    three = surface_strain(xyz, moved, NONE + 1.0, ALL, gauge_length=6.0, threads=3)
    np.testing.assert_array_equal(one.strain, three.strain)
    np.testing.assert_array_equal(one.sigma, three.sigma)
