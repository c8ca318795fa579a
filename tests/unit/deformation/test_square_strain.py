"""Strain over squares of pixels: exact for linear displacement, as noisy as stated, and like the disc's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import signal
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.arrays import Floats, Labels
from sms_jobs.metrology.deformation.fields.averaging import average_in_region
from sms_jobs.metrology.deformation.fields.noise_correlation import blended_weights
from sms_jobs.metrology.deformation.fields.spatial_resolution import left_by_square
from sms_jobs.metrology.deformation.matching.finer_subsets import Subsets
from sms_jobs.metrology.deformation.strain.square import radius_of_equal_spread, strain_over_squares
from sms_jobs.metrology.deformation.strain.strain_errors import SharedErrors, Window, shared_errors
from sms_jobs.metrology.deformation.strain.tangent_plane import SurfaceStrain, surface_strain

ROWS, COLUMNS, PITCH = 60, 64, 0.5
NONE = np.zeros((6, ROWS, COLUMNS))
ALL = np.ones((ROWS, COLUMNS), np.int32)


def independent(covariance: Floats = NONE) -> Callable[[int], SharedErrors]:
    """Return errors that are independent from pixel to pixel."""
    nothing = np.zeros(covariance.shape, np.float32)
    return lambda side: SharedErrors(covariance, nothing, 0.0, 0.0, radius_of_equal_spread(side))


def plane(tilt: tuple[float, float] = (0.0, 0.0), turn: float = 0.0) -> Floats:
    """Return a plane seen from +Z, in mm: x to the right, y up, and the image turned about its middle."""
    row, column = np.mgrid[0:ROWS, 0:COLUMNS]
    right, up = PITCH * (column - COLUMNS / 2), -PITCH * (row - ROWS / 2)
    x, y = right * np.cos(turn) - up * np.sin(turn), right * np.sin(turn) + up * np.cos(turn)
    return np.stack([x, y, tilt[0] * x + tilt[1] * y])


def carried(matrix: Floats, xyz: Floats) -> Floats:
    return np.asarray(np.einsum("ij,jrc->irc", matrix, xyz))


def cylinder(radius: float = 40.0) -> Floats:
    """Return part of a cylinder about y, evenly spaced along its arc."""
    x, y, _ = plane()
    return np.stack([radius * np.sin(x / radius), y, radius * (np.cos(x / radius) - 1.0)])


def test_rows_and_columns_are_fitted_as_the_thesis_does(rng: np.random.Generator) -> None:
    """Rows along x: slopes of lines against x along each row, averaged, and against y along columns."""
    xyz, moved, half = plane(), 1e-3 * rng.normal(size=(3, ROWS, COLUMNS)), 3
    found = strain_over_squares(xyz, moved, independent(), ALL, side=7, green_lagrange=False)
    for row, column in ((20, 30), (3, 3), (40, 7)):
        part = np.s_[row - half : row + half + 1, column - half : column + half + 1]
        x, y = xyz[0][part], xyz[1][part]
        dx, dy = ([np.polyfit(x[k], d[k], 1)[0] for k in range(7)] for d in (moved[0][part], moved[1][part]))
        ex, ey = (
            [np.polyfit(y[:, k], d[:, k], 1)[0] for k in range(7)] for d in (moved[0][part], moved[1][part])
        )
        expected = [np.mean(dx), np.mean(ey), 0.5 * (np.mean(dy) + np.mean(ex))]
        # Rounding.
        np.testing.assert_allclose(found.strain[:, row, column], expected, atol=1e-14)


@pytest.mark.parametrize("green", [True, False])
def test_linear_fields_are_exact_on_any_plane_however_it_is_seen(green: bool) -> None:
    xyz = plane((0.4, -0.2), 0.6)
    gradient = np.array([[2e-3, 1e-3, 0.0], [-4e-4, -1e-3, 5e-4], [3e-3, 0.0, 1e-3]])
    axis = np.array([0.8, 0.6, 0.0])
    labels = ALL.copy()
    labels[20:24, 30:33] = 0  # what lacks pixels is exact too
    found = strain_over_squares(
        xyz,
        carried(gradient, xyz),
        independent(),
        labels,
        side=7,
        x_axis=(0.8, 0.6, 0.0),
        green_lagrange=green,
    )
    normal = np.array([-0.4, 0.2, 1.0]) / np.linalg.norm([-0.4, 0.2, 1.0])
    x = axis - normal * (normal @ axis)
    frame = np.stack([x / np.linalg.norm(x), np.cross(normal, x / np.linalg.norm(x))], axis=1)
    e = 0.5 * frame.T @ (gradient + gradient.T + green * gradient.T @ gradient) @ frame
    known = np.isfinite(found.strain[0])
    # A corner has 16 of 49 pixels, and its neighbour 20, but the next 24: less than half.
    assert np.count_nonzero(~known) == np.count_nonzero(labels == 0) + 4 * 5
    expected = np.array([e[0, 0], e[1, 1], e[0, 1]])[:, None]
    # Rounding of 10^-15 mm over the square's 3 mm.
    np.testing.assert_allclose(found.strain[:, known], expected.repeat(known.sum(), axis=1), atol=1e-14)
    assert not found.bias[:, known].any()


@pytest.mark.parametrize("surface", [plane((0.3, 0.1)), cylinder()], ids=["plane", "cylinder"])
def test_a_rigid_motion_is_no_green_lagrange_strain(surface: Floats) -> None:
    turn = Rotation.from_rotvec([0.2, -0.3, 0.5]).as_matrix() - np.eye(3)
    moved = carried(turn, surface) + np.array([3.0, -2.0, 1.0])[:, None, None]
    labels = ALL.copy()
    labels[:, :7] = 0
    labels[20:30, 30:45] = 0
    found = strain_over_squares(surface, moved, independent(), labels, side=7)
    # Rounding of 30 mm over 3 mm.
    assert np.nanmax(np.abs(found.strain)) < 1e-13


def test_a_rotation_is_small_strain_as_the_thesis_would_have_it() -> None:
    xyz, angle = plane(), 0.02
    turn = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix() - np.eye(3)
    found = strain_over_squares(xyz, carried(turn, xyz), independent(), ALL, side=7, green_lagrange=False)
    expected = np.array([np.cos(angle) - 1.0, np.cos(angle) - 1.0, 0.0])
    np.testing.assert_allclose(found.strain[:, 30, 30], expected, atol=1e-13)


def test_a_tilted_plane_that_turns_is_not_strained_as_over_the_axes_of_a_frame() -> None:
    """Over x of a frame tilted by tau against the plane a rotation w about y would be a strain w tan(tau)."""
    xyz, angle, tilt = plane((np.tan(np.radians(5.0)), 0.0)), 1e-3, np.tan(np.radians(5.0))
    turn = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix() - np.eye(3)
    moved = carried(turn, xyz)
    over_frame = np.polyfit(xyz[0, 30, 27:34], moved[0, 30, 27:34], 1)[0]
    assert over_frame == pytest.approx(angle * tilt, rel=0.01)
    found = strain_over_squares(xyz, moved, independent(), ALL, side=7, green_lagrange=False)
    np.testing.assert_allclose(found.strain[:, 30, 30], [np.cos(angle) - 1.0, 0.0, 0.0], atol=1e-13)


def test_pixels_without_a_value_regions_and_folds_are_left_out() -> None:
    xyz = plane()
    labels = ALL.copy()
    labels[:, 32:] = 2
    moved = np.where(labels == 2, 5.0 + 1e-3 * xyz, 0.0)
    moved[:, 10, 10] = np.nan
    moved[:, 40:50, 5:15] = np.nan

    def strained(moved: Floats, labels: Labels) -> SurfaceStrain:
        return strain_over_squares(xyz, moved, independent(), labels, side=7, green_lagrange=False)

    found = strained(moved, labels)
    known = np.isfinite(found.strain[0])
    assert not known[10, 10]
    assert not known[40:50, 5:15].any()
    assert known[30, 31:33].all()
    expected = np.where(labels == 2, 1e-3, 0.0)
    # Rounding of 5 mm over 3 mm.
    np.testing.assert_allclose(found.strain[0][known], expected[known], atol=1e-14)
    # Of a region of one row a square has a seventh.
    alone = np.where(np.arange(ROWS)[:, None] == 30, ALL, 0)
    assert np.isnan(strained(moved, alone).strain).all()
    nothing = strained(np.full_like(xyz, np.nan), ALL)
    assert np.isnan(nothing.strain).all()
    assert np.isnan(nothing.sigma).all()


def test_a_square_does_not_reach_across_a_fold() -> None:
    # A roof: one side stands still, the other, 57 degrees steeper, is stretched by 0.2 % down its slope.
    x, y, _ = flat = plane()
    column = np.broadcast_to(np.arange(COLUMNS), (ROWS, COLUMNS))
    right = column >= COLUMNS // 2
    slope = np.array([np.cos(1.0), 0.0, -np.sin(1.0)])[:, None, None]
    xyz = np.where(right, slope * x + np.array([0.0, 1.0, 0.0])[:, None, None] * y, flat)
    moved = np.where(right, 2e-3 * slope * x, 0.0)
    expected = np.where(right, 2e-3 + 0.5 * 2e-3**2, 0.0)
    near = np.abs(column - COLUMNS // 2 + 0.5) <= 1.5  # normals are told by both neighbours
    for angle, is_exact in ((0.35, True), (np.pi, False)):
        found = strain_over_squares(xyz, moved, independent(), ALL, side=7, fold_angle_rad=angle).strain[0]
        error = np.abs(found - expected)[3:-3][~near[3:-3]]
        assert (np.nanmax(error) < 1e-13) == is_exact


def test_what_a_square_sees_of_white_noise_is_the_thesiss_formula(rng: np.random.Generator) -> None:
    sigma = 0.004
    covariance = NONE.copy()
    covariance[[0, 3, 5]] = sigma**2
    found = strain_over_squares(plane(), np.zeros((3, ROWS, COLUMNS)), independent(covariance), ALL, side=7)
    # A mean of 7 slopes, each of sigma^2 over the spread of 7 places, 28 px^2.
    of_slope = sigma / PITCH / np.sqrt(7.0 * 28.0)
    expected = [of_slope, of_slope, of_slope / np.sqrt(2.0)]
    np.testing.assert_allclose(found.sigma[:, 30, 30], expected, rtol=1e-12)


@pytest.mark.parametrize("side", [3, 7, 15])
def test_scatter_is_as_stated(rng: np.random.Generator, side: int) -> None:
    xyz = plane((0.5, 0.0), 0.3)
    sigma = np.array([0.004, 0.002, 0.01])
    covariance = NONE.copy()
    covariance[[0, 3, 5]] = (sigma**2)[:, None, None]
    moved = 0.05 * np.stack([xyz[0], np.zeros_like(xyz[0]), xyz[1]])
    labels = ALL.copy()
    labels[rng.random(ALL.shape) < 0.1] = 0  # some lack
    trials = []
    for _ in range(16):
        noise = sigma[:, None, None] * rng.normal(size=xyz.shape)
        found = strain_over_squares(xyz, moved + noise, independent(covariance), labels, side=side)
        trials.append(found.strain)
    at = np.s_[:, 2:-2:6, 2:-2:6]
    stated = np.sqrt(found.sigma**2 - found.bias**2)[at]
    ratio = np.sqrt(np.nanmean(np.var(trials, axis=0, ddof=1)[at] / stated**2, axis=(1, 2)))
    # 16 trials at a dozen or more independent places: 5 %.
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


def test_matches_are_spread_as_their_variance_says() -> None:
    weights, stated = blended_weights(Subsets(10, 1))
    assert weights.sum() == pytest.approx(1.0)
    assert np.sum(weights**2) == pytest.approx(stated, rel=0.005)
    # The factor of `blend_matches`.
    assert np.sum(weights**2) * 21**2 == pytest.approx(1.39, abs=0.005)
    # A linear displacement stays what it is: the first moments vanish.
    place = np.arange(weights.shape[0]) - weights.shape[0] // 2
    assert abs(weights.sum(axis=0) @ place) < 1e-12


@pytest.mark.parametrize("side", [7, 15])
def test_noise_that_neighbours_share_is_stated_within_a_fifth(rng: np.random.Generator, side: int) -> None:
    """Errors of shape, averaged over 4 px, and of matches with subsets of 13 px, spread over the pixels."""
    size, radius, subset, of_shape, of_match = 128, 4.0, 6, 0.004, 0.01
    row, column = np.mgrid[0:size, 0:size]
    xyz, labels = np.stack([PITCH * column, -PITCH * row, 0.0 * row]), np.ones((size, size), np.int32)
    cloud, weights = np.zeros((6, size, size)), blended_weights(Subsets(subset, 1))[0]
    cloud[[0, 3, 5]] = 0.5 * of_shape**2
    wide = size + weights.shape[0] - 1
    squares, covariance = [], cloud
    for _ in range(3):
        moved, covariance = average_in_region(
            of_shape * rng.normal(size=xyz.shape), 2.0 * cloud, labels, labels > 0, radius
        )
        for k, at in enumerate((0, 3, 5)):
            moved[k] += of_match * signal.fftconvolve(rng.normal(size=(wide, wide)), weights, "valid")
            covariance[at] += of_match**2 * np.sum(weights**2)

        def errors_of(side: int, covariance: Floats = covariance) -> SharedErrors:
            return shared_errors(
                covariance,
                cloud,
                averaging_radius_px=radius,
                subset_radius_px=subset,
                disc_radius_px=radius_of_equal_spread(side),
                window=Window(side, side),
            )

        found = strain_over_squares(xyz, moved, errors_of, labels, side=side)
        squares.append(found.strain[:, 20:-20, 20:-20] ** 2)
    stated = np.mean(found.sigma[:, 20:-20, 20:-20] ** 2, axis=(1, 2))
    ratio = np.sqrt(stated / np.mean(squares, axis=(0, 2, 3)))
    # The required 0.8 to 1.2, of which 7 % are by 3 x 60 places that are independent.
    np.testing.assert_allclose(ratio, 1.0, atol=0.2)


def test_large_squares_see_what_discs_with_the_same_spread_see() -> None:
    cloud = NONE + np.eye(3)[np.triu_indices(3)][:, None, None]
    disc, square = (
        shared_errors(
            3.0 * cloud,
            cloud,
            averaging_radius_px=4.0,
            subset_radius_px=10,
            disc_radius_px=radius_of_equal_spread(81),
            window=window,
        )
        for window in (None, Window(81, 81))
    )
    # The disc's fitted factors are good to 10 %.
    np.testing.assert_allclose(disc.match, square.match, rtol=0.1)
    inner = np.s_[[0, 3, 5], 8:-8, 8:-8]
    np.testing.assert_allclose(square.own[inner], 2.0 * 0.93, rtol=0.1)
    np.testing.assert_allclose(disc.own[inner], square.own[inner], rtol=0.1)


def test_it_agrees_with_the_disc_on_a_smooth_field() -> None:
    xyz = plane()
    x, y, _ = xyz
    wave = 2.0 * np.pi / 40.0
    moved = np.stack([2e-3 / wave * np.sin(wave * x), 1e-3 / wave * np.sin(wave * y), 1e-4 * x * y])
    square = strain_over_squares(xyz, moved, independent(), ALL, side=9)
    disc = surface_strain(xyz, moved, NONE, ALL, gauge_length=2.0 * PITCH * radius_of_equal_spread(9))
    inner = np.s_[:, 8:-8, 8:-8]
    # Each leaves out the side squared over about a hundred and the wave squared: 1 % of the strain.
    np.testing.assert_allclose(square.strain[inner], disc.strain[inner], atol=4e-5)


def test_what_is_left_of_a_wave_is_what_the_square_leaves() -> None:
    xyz, side = plane(), 15
    for along in (0, 1):
        period = 60.0 * PITCH
        wave, z = 2.0 * np.pi / period, np.pi * side * PITCH / period
        true, moved = 1e-4 * np.cos(wave * xyz[along]), np.zeros_like(xyz)
        moved[0] = 1e-4 / wave * np.sin(wave * xyz[0]) if along == 0 else true * xyz[0]
        found = strain_over_squares(xyz, moved, independent(), ALL, side=side, green_lagrange=False)
        at = ROWS // 2, COLUMNS // 2
        left = 3.0 * (np.sin(z) - z * np.cos(z)) / z**3 if along == 0 else left_by_square(np.array(np.pi / z))
        # Sums over 15 px instead of integrals take less, by up to 7 / 3 / 15^2 of it.
        assert found.strain[0][at] / true[at] == pytest.approx(left, abs=0.012 * (1.0 - left))


def test_what_bends_within_a_square_is_in_sigma(rng: np.random.Generator) -> None:
    xyz, sigma, side = plane(), 1e-4, 15
    covariance = NONE.copy()
    covariance[[0, 3, 5]] = sigma**2
    of_slope = sigma / PITCH / np.sqrt(side * side * (side**2 - 1) / 12.0)
    for along in (0, 1):
        wave = 2.0 * np.pi / (2.0 * side * PITCH)
        amplitude = 30.0 * of_slope
        true = amplitude * np.cos(wave * xyz[along])
        moved = np.zeros_like(xyz)
        moved[0] = amplitude / wave * np.sin(wave * xyz[0]) if along == 0 else true * xyz[0]
        moved += sigma * rng.normal(size=xyz.shape)
        found = strain_over_squares(xyz, moved, independent(covariance), ALL, side=side, green_lagrange=False)
        known = np.isfinite(found.strain[0])
        error = np.abs(found.strain[0] - true)[known]
        assert (error > 3.0 * of_slope).mean() > 0.3
        assert (error > 3.0 * found.sigma[0][known]).mean() < 0.01


def test_threads_do_not_matter(rng: np.random.Generator) -> None:
    xyz, moved = np.tile(cylinder(), (1, 2, 1)), rng.normal(size=(3, 2 * ROWS, COLUMNS))
    labels, errors = np.tile(ALL, (2, 1)), independent(np.tile(NONE + 1.0, (1, 2, 1)))
    one, three = (strain_over_squares(xyz, moved, errors, labels, side=7, threads=n) for n in (1, 3))
    np.testing.assert_array_equal(one.strain, three.strain)
    np.testing.assert_array_equal(one.sigma, three.sigma)
