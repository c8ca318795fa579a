"""Points from the images of several cameras."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from support.two_cameras import VOLUME, Floats, cameras

from sms_jobs.metrology.geometry.camera import Camera, Pose, project, ray_directions
from sms_jobs.metrology.geometry.several_cameras import (
    depths_in_box,
    directions_across_rays,
    meet_rays,
    plane_warps,
    slopes_of_places,
)

SIGMA = 0.02


def points(count: int, seed: int = 3) -> Floats:
    random = np.random.default_rng(seed)
    return random.uniform((-40.0, -30.0, -30.0), (40.0, 30.0, 30.0), (count, 3))


def in_images(world: Floats, count: int) -> tuple[tuple, Floats, Floats]:
    """Return the cameras, and where the first and the others see points, (2, n) and (partners, 2, n)."""
    rig = cameras(count=count)
    seen = np.stack([project(camera.intrinsics, camera.pose, world).T for camera in rig])
    return rig, seen[0], seen[1:]


@pytest.mark.parametrize("count", [2, 3, 4])
def test_exact_images_meet_in_the_exact_point(count: int) -> None:
    world = points(200)
    (reference, *partners), pixels, places = in_images(world, count)
    met = meet_rays(reference, partners, pixels, places, np.full_like(places, SIGMA))
    # Of 600 mm in doubles, through Newton's inverse of the distortion that ends at 1e-12 focal lengths.
    np.testing.assert_allclose(met.xyz.T, world, atol=1e-8)
    assert np.abs(met.ray_gap).max() < 1e-8
    assert met.chi_square.max() < 1e-8
    assert set(met.freedom) == {2 * (count - 1) - 1}


@pytest.mark.parametrize("count", [2, 3])
def test_points_scatter_as_their_covariance_says(count: int) -> None:
    """Half of a match's variance is the reference image's, which moves the matches of all partners alike."""
    world = np.repeat(points(1), 4000, axis=0)
    (reference, *partners), pixels, _ = in_images(world, count)
    random = np.random.default_rng(11)
    own = random.normal(0.0, SIGMA / np.sqrt(2.0), pixels.shape)
    rays = ray_directions(reference.intrinsics, reference.pose, (pixels + own).T)
    depth = np.linalg.norm(world - reference.pose.centre(), axis=1)
    moved = reference.pose.centre() + depth[:, None] * rays
    noisy = np.stack([project(one.intrinsics, one.pose, moved).T for one in partners])
    noisy += random.normal(0.0, SIGMA / np.sqrt(2.0), noisy.shape)
    met = meet_rays(reference, partners, pixels, noisy, np.full_like(noisy, SIGMA))
    variance = met.covariance[[0, 3, 5]].sum(axis=0)
    score = np.sum((met.xyz.T - world) ** 2, axis=1) / variance
    # A chi-square law of one degree of freedom, four thousand times: its mean scatters by sqrt(2 / 4000).
    assert np.mean(score) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 4000.0))
    freedom = 2 * (count - 1) - 1
    assert np.mean(met.chi_square) == pytest.approx(freedom, abs=4.0 * np.sqrt(2.0 * freedom / 4000.0))


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("tilt", [-0.9, 0.9, 1.5])
def test_points_of_a_tilted_surface_scatter_as_their_covariance_says(count: int, tilt: float) -> None:
    """What the reference image is wrong by moves the matches along the surface, wherever that leads."""
    (reference, *partners), pixels, _ = in_images(points(1), count)
    normal = np.array([np.sin(tilt), 0.3, -np.cos(tilt)])
    at = ray_directions(reference.intrinsics, reference.pose, pixels.T)[0] * 610.0 + reference.pose.centre()

    def places(own: Floats) -> Floats:
        """Return where partners see the points of a plane that the reference camera sees in pixels (2, n)."""
        rays = ray_directions(reference.intrinsics, reference.pose, own.T)
        along = (at - reference.pose.centre()) @ normal / (rays @ normal)
        world = reference.pose.centre() + along[:, None] * rays
        return np.stack([project(one.intrinsics, one.pose, world).T for one in partners])

    step = 0.5
    sides = [places(pixels + step * one[:, None]) - places(pixels - step * one[:, None]) for one in np.eye(2)]
    slopes = np.stack(sides, axis=2) / (2.0 * step)
    draws = 4000
    random = np.random.default_rng(11)
    noisy = places(pixels + random.normal(0.0, SIGMA / np.sqrt(2.0), (2, draws)))
    noisy += random.normal(0.0, SIGMA / np.sqrt(2.0), noisy.shape)
    sigma, many = np.full_like(noisy, SIGMA), np.repeat(pixels, draws, axis=1)
    met = meet_rays(reference, partners, many, noisy, sigma, np.repeat(slopes, draws, axis=3))
    variance = met.covariance[[0, 3, 5]].sum(axis=0)
    score = np.sum((met.xyz.T - at) ** 2, axis=1) / variance
    # A chi-square law of one degree of freedom, four thousand times: its mean scatters by sqrt(2 / 4000).
    assert np.mean(score) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / draws))
    freedom = 2 * (count - 1) - 1
    assert np.mean(met.chi_square) == pytest.approx(freedom, abs=4.0 * np.sqrt(2.0 * freedom / draws))


@pytest.mark.parametrize("off_px", [SIGMA, 1.0])
def test_what_ends_early_is_at_the_least_sum_of_squares(off_px: float) -> None:
    """A general solver goes on until nothing changes: a thousandth of a deviation may be left."""
    (reference, *partners), pixels, places = in_images(points(20), 3)
    random = np.random.default_rng(5)
    places = places + random.normal(0.0, off_px, places.shape)
    slopes = np.broadcast_to(np.eye(2)[None, :, :, None], (2, 2, 2, 20)) + random.normal(
        0, 0.2, (2, 2, 2, 20)
    )
    met = meet_rays(reference, partners, pixels, places, np.full_like(places, SIGMA), slopes)
    centre = reference.pose.centre()
    rays = ray_directions(reference.intrinsics, reference.pose, pixels.T)
    for i, ray in enumerate(rays):

        def residuals(unknown: Floats, i: int = i, ray: Floats = ray) -> Floats:
            at = (centre + unknown[2] * ray)[None]
            seen = np.stack([project(one.intrinsics, one.pose, at)[0] for one in partners])
            off = places[:, :, i] - seen - slopes[:, :, :, i] @ unknown[:2]
            return np.sqrt(2.0) / SIGMA * np.concatenate([unknown[:2], off.ravel()])

        start = np.array([0.0, 0.0, np.linalg.norm(met.xyz[:, i] - centre)])
        scale = np.array([SIGMA, SIGMA, 0.1])
        best = least_squares(residuals, start, x_scale=scale, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        deviation = np.sqrt(met.covariance[[0, 3, 5], i].sum())
        assert abs(start[2] - best.x[2]) < 1e-3 * deviation
        # The root of a sum of squares changes by no more than its residuals do.
        chi_square = 2.0 * best.cost
        assert met.chi_square[i] == pytest.approx(chi_square, abs=2e-3 * np.sqrt(chi_square))


def test_a_third_camera_halves_nothing_that_it_shares() -> None:
    """The third camera sees the depth by twice the angle; what the reference image is wrong by stays."""
    world = points(50)
    (reference, *partners), pixels, places = in_images(world, 3)
    sigma = np.full_like(places, SIGMA)
    both = meet_rays(reference, partners, pixels, places, sigma).covariance[5]
    alone = [meet_rays(reference, [p], pixels, places[k, None], sigma[k, None]).covariance[5]
             for k, p in enumerate(partners)]  # fmt: skip
    independent = 1.0 / (1.0 / alone[0] + 1.0 / alone[1])
    assert (both < np.minimum(*alone)).all()
    assert (both > independent).all()


def test_what_a_partner_does_not_see_does_not_count() -> None:
    world = points(10)
    (reference, *partners), pixels, places = in_images(world, 3)
    sigma = np.full_like(places, SIGMA)
    places[0, :, :4] = np.nan
    places[:, :, 9] = np.nan
    met = meet_rays(reference, partners, pixels, places, sigma)
    assert list(met.freedom) == [1] * 4 + [3] * 5 + [0]
    np.testing.assert_allclose(met.xyz.T[:9], world[:9], atol=1e-8)
    assert np.isnan(met.xyz[:, 9]).all()


def test_no_result_depends_on_the_threads() -> None:
    world = points(9000)
    (reference, *partners), pixels, places = in_images(world, 2)
    noisy = places + np.random.default_rng(1).normal(0.0, SIGMA, places.shape)
    one, two = (meet_rays(reference, partners, pixels, noisy, 0.0 * noisy + SIGMA, threads=t) for t in (1, 2))
    np.testing.assert_array_equal(one.xyz, two.xyz)
    np.testing.assert_array_equal(one.chi_square, two.chi_square)


def test_a_plane_looks_as_its_points_do() -> None:
    reference, partner = cameras()
    pixels = np.array([[120.0, 80.0], [300.0, 220.0]])
    rays = ray_directions(reference.intrinsics, reference.pose, pixels)
    met = reference.pose.centre() + 610.0 * rays
    normal = np.array([0.3, -0.2, 1.0])
    lever = 8.0
    places, slopes = plane_warps(
        reference, partner, pixels, met[:, None], np.broadcast_to(normal, (2, 1, 3)), lever
    )
    for k in range(2):
        beside = pixels[k] + [3.0, -5.0]
        ray = ray_directions(reference.intrinsics, reference.pose, beside)
        on_plane = reference.pose.centre() + ray * (
            normal @ (met[k] - reference.pose.centre()) / (normal @ ray)
        )
        exact = project(partner.intrinsics, partner.pose, on_plane)
        # What is left is the homography's curvature, a square of 6 px over a focal length of 2400 px.
        np.testing.assert_allclose(places[k, 0] + slopes[k, 0] @ [3.0, -5.0], exact, atol=2.0 * 34.0 / 2400.0)


def test_rays_know_where_they_pass_a_box() -> None:
    camera = cameras()[0]
    pixels = np.array([[200.0, 149.0], [-9000.0, 150.0]])
    rays, near, far = depths_in_box(camera, pixels, *VOLUME)
    for depth in (near[0], far[0]):
        place = camera.pose.centre() + depth * rays[0]
        outside = np.maximum(np.subtract(VOLUME[0], place), np.subtract(place, VOLUME[1])).max()
        assert outside == pytest.approx(0.0, abs=1e-9)
    assert near[0] < far[0]
    assert np.isnan(near[1])
    assert np.isnan(far[1])


def test_slopes_of_places_are_exact_of_a_plane_up_to_its_borders() -> None:
    """Between two sides where there are both, from one where there is one, unknown where there is none."""
    true = np.array([[1.1, -0.2], [0.05, 0.9]])
    pixels = np.moveaxis(np.stack(np.meshgrid(np.arange(30.0), np.arange(20.0)), axis=-1), -1, 0)
    place = np.einsum("ij,jrc->irc", true, pixels) + 3.0
    place[:, :, 12:16] = np.nan
    found = slopes_of_places(place, 4)
    there = np.isfinite(place[0])
    np.testing.assert_allclose(found[:, :, there] - true[..., None], 0.0, atol=1e-12)
    alone = np.full((2, 20, 30), np.nan)
    alone[:, 10, 10] = 5.0
    assert np.isnan(slopes_of_places(alone, 4)).all()


@pytest.mark.parametrize("centre", [(205.0, 0.0, 564.0), (0.0, -205.0, 564.0), (-150.0, 150.0, 564.0)])
def test_what_a_partner_takes_for_one_place_lies_across_nothing(centre: tuple[float, float, float]) -> None:
    """Points of a partner's ray lie on one line in the reference image, and across it none is off."""
    reference = cameras(columns=410)[0]
    up = np.array([0.0, 1.0, 0.0])
    partner = Camera(reference.intrinsics, Pose.looking_at(np.array(centre), np.zeros(3), up), 410, 300)
    across = directions_across_rays(reference, partner)
    assert across.shape == (2, 300, 410)
    np.testing.assert_allclose(np.hypot(*across), 1.0)
    pixels = np.array([[0.0, 0.0], [409.0, 299.0], [57.0, 203.0], [300.0, 31.0], [409.0, 0.0]])
    rays = ray_directions(reference.intrinsics, reference.pose, pixels)
    met = reference.pose.centre() + 600.0 * rays
    nearer = met + 0.01 * (partner.pose.centre() - met)
    line = project(reference.intrinsics, reference.pose, nearer) - pixels
    x, y = pixels.astype(int).T
    # All lines meet in the epipole, 5.67 focal lengths away: over half of a square's diagonal they turn by
    # 11.3 px over 13,600 px, and distortion bends each by 0.0002 over the 13 px that are taken.
    off = (across[:, y, x].T * line).sum(axis=1) / np.linalg.norm(line, axis=1)
    assert np.abs(off).max() < 0.0011


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("tilt", [0.0, -0.9, 1.5])
def test_what_the_reference_image_moves_a_point_by_is_a_difference(count: int, tilt: float) -> None:
    """The derivative of the point by a shift of all matches along the surface, with weights of any size."""
    (reference, *partners), pixels, _ = in_images(points(1), count)
    normal = np.array([np.sin(tilt), 0.3, -np.cos(tilt)])
    at = ray_directions(reference.intrinsics, reference.pose, pixels.T)[0] * 610.0 + reference.pose.centre()
    step = 1e-3
    shifts = step * np.array([[0.0, 1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, -1.0]])
    rays = ray_directions(reference.intrinsics, reference.pose, (pixels + shifts).T)
    along = (at - reference.pose.centre()) @ normal / (rays @ normal)
    world = reference.pose.centre() + along[:, None] * rays
    places = np.stack([project(one.intrinsics, one.pose, world).T for one in partners])
    slopes = np.stack([places[..., 1] - places[..., 2], places[..., 3] - places[..., 4]], -1) / (2.0 * step)
    sigma = SIGMA * np.random.default_rng(5).uniform(0.5, 2.0, (count - 1, 2, 1))
    many = [np.repeat(one, 5, axis=-1) for one in (pixels, sigma, slopes[..., None])]
    met = meet_rays(reference, partners, many[0], places, many[1], many[2])
    depth = np.linalg.norm(met.xyz.T - reference.pose.centre(), axis=1)
    found = [(depth[1] - depth[2]) / (2.0 * step), (depth[3] - depth[4]) / (2.0 * step)]
    # A step of 10^-3 px bends the images by the square of 10^-3 / 2400.
    np.testing.assert_allclose(met.by_own[:, 0], found, rtol=1e-4, atol=1e-6)
