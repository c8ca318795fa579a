"""Spheres are found among other things, where they are, with the error that is promised."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians, sin

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.calibration.stage.pan_tilt import (
    Stage,
    label_special_poses,
    predict_centres,
    prediction_covariance,
    stage_from_special_poses,
)
from sms_jobs.metrology.calibration.stage.pan_tilt_refinement import (
    refine_stage,
    search_margin_mm,
    sphere_regions,
)
from sms_jobs.metrology.geometry.camera import Pose, pixel_grid, project, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.targets.sphere_fit import fit_sphere, ray_residuals, spread_pixels
from sms_jobs.metrology.targets.sphere_layout import SphereLayout
from sms_jobs.metrology.targets.sphere_votes import sphere_peaks
from sms_jobs.metrology.targets.spheres import INCIDENCE_LIMIT, SphereSearch, find_spheres

Floats = NDArray[np.float64]

SIZE = 320
CAMERA = Intrinsics(1.1 * SIZE, 1.1 * SIZE, (SIZE - 1) / 2, (SIZE - 1) / 2)
POSE = Pose.looking_at(np.array([30.0, -20.0, -1100.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
PINHOLE = POSE.centre()
RAYS = ray_directions(CAMERA, POSE, pixel_grid(SIZE, SIZE))
RADIUS = 45.0  # 29 px across
CENTRES = np.array([[-180.0, -60.0, 50.0], [190.0, 70.0, -60.0]])
LENGTH = float(np.linalg.norm(CENTRES[1] - CENTRES[0]))
BAR = SphereLayout(bar_length_mm=LENGTH)


@dataclass
class Cloud:
    """Distances along the rays of what is nearest."""

    distance: Floats

    def add(self, distance: Floats) -> Cloud:
        return Cloud(np.fmin(self.distance, np.where(distance > 0.0, distance, np.nan)))

    def sphere(self, centre: Floats, radius: float = RADIUS) -> Cloud:
        to = centre - PINHOLE
        along = RAYS @ to
        with np.errstate(invalid="ignore"):
            return self.add(along - np.sqrt(radius**2 - (to @ to - along**2)))

    def cylinder(self, start: ArrayLike, end: ArrayLike, radius: float) -> Cloud:
        a, b = np.asarray(start), np.asarray(end)
        axis = (b - a) / np.linalg.norm(b - a)
        rays, to = RAYS - (RAYS @ axis)[..., None] * axis, a - PINHOLE - ((a - PINHOLE) @ axis) * axis
        square, cross = np.sum(rays**2, axis=-1), rays @ to
        with np.errstate(invalid="ignore"):
            distance = (cross - np.sqrt(cross**2 - square * (to @ to - radius**2))) / square
        height = (PINHOLE + distance[..., None] * RAYS - a) @ axis
        return self.add(np.where((height > 0.0) & (height < np.linalg.norm(b - a)), distance, np.nan))

    def plane(self, point: Floats, normal: Floats) -> Cloud:
        return self.add(((point - PINHOLE) @ normal) / (RAYS @ normal))

    def points(self, sigma: float = 0.0, rng: np.random.Generator | None = None) -> Floats:
        noise = sigma * rng.standard_normal(self.distance.shape) if rng is not None else 0.0
        return np.ascontiguousarray(np.moveaxis(PINHOLE + (self.distance + noise)[..., None] * RAYS, -1, 0))


def nothing() -> Cloud:
    return Cloud(np.full((SIZE, SIZE), np.nan))


def two_spheres() -> Cloud:
    return nothing().sphere(CENTRES[0]).sphere(CENTRES[1])


def cluttered() -> Cloud:
    """A bar on a tripod before a wall, with rods as thick as the spheres and a ball of another size."""
    middle, down = CENTRES.mean(axis=0), np.array([0.0, 80.0, 60.0])
    cloud = two_spheres().cylinder(CENTRES[0], CENTRES[1], 15.0).sphere(np.array([-250.0, 250.0, 0.0]), 65.0)
    for side in (-1.0, 0.0, 1.0):
        cloud = cloud.cylinder(middle + down, middle + np.array([200 * side, 500, 120]), RADIUS)
    cloud = cloud.cylinder(np.array([-400.0, -300, 0]), np.array([400.0, -330, 0]), RADIUS)
    return cloud.plane(np.array([0.0, 0.0, 300.0]), np.array([0.2, 0.1, 1.0]))


def dirty(cloud: Cloud, rng: np.random.Generator) -> Cloud:
    """Add points that are anywhere, and holes."""
    draw = rng.random(cloud.distance.shape)
    wrong = cloud.distance + rng.uniform(-200.0, 200.0, cloud.distance.shape)
    return Cloud(np.where(draw < 0.02, wrong, np.where(draw > 0.95, np.nan, cloud.distance)))


def in_standard_deviations(search: SphereSearch) -> list[float]:
    """Return the squared lengths of the centres' errors in standard deviations."""
    off = [sphere.centre - centre for sphere, centre in zip(search.spheres, CENTRES, strict=True)]
    return [float(e @ np.linalg.solve(s.covariance, e)) for e, s in zip(off, search.spheres, strict=True)]


def test_spheres_alone_are_found_exactly() -> None:
    search = find_spheres(two_spheres().points(), 0.1, RADIUS, PINHOLE, layout=BAR)
    assert search.problems == ()
    assert search.searched_fraction == 1.0
    assert search.separation_mm == pytest.approx(LENGTH, abs=1e-8)
    for sphere, centre, number in zip(search.spheres, CENTRES, (1, 2), strict=True):
        # Coordinates of 1100 mm with 1e-13 mm of rounding, and a fit that stops at 1e-9 of the radius.
        assert sphere.centre == pytest.approx(centre, abs=1e-9)
        assert sphere.radius == pytest.approx(RADIUS, abs=1e-7)
        assert sphere.number == number
        assert sphere.coverage == 1.0
        assert sphere.rms < 1e-9


@pytest.mark.parametrize("sigma", [0.1, 0.5, 1.0])
def test_spheres_are_found_among_other_things(sigma: float, rng: np.random.Generator) -> None:
    squared = []
    for _ in range(4):
        points = dirty(cluttered(), rng).points(sigma, rng)
        search = find_spheres(points, sigma, RADIUS, PINHOLE, layout=BAR)
        assert search.problems == ()
        assert sum(search.refused.values()) > 0
        squared += in_standard_deviations(search)
        for sphere in search.spheres:
            assert sphere.misfit < 1.2  # of some 400 points: 1 +- 0.035; a few others pass for them
            assert abs(sphere.radius - RADIUS) < 5 * sphere.radius_sigma
            assert sphere.refused["behind the surface"] + sphere.refused["in front of the surface"] > 0
    # Chi-square with 3 degrees each: 1 in 10,000 is above 21.

    assert max(squared) < 21.0
    assert np.mean(squared) / 3.0 < 1.0 + 4.0 * np.sqrt(2.0 / 24.0)


def sphere_pixels(radius: float = RADIUS) -> tuple[Floats, Floats]:
    """Return rays and distances of the pixels that see the first sphere."""
    cloud = nothing().sphere(CENTRES[0], radius)
    seen = np.isfinite(cloud.distance)
    return RAYS[seen], cloud.distance[seen]


def test_scatter_is_as_promised_and_there_is_no_bias(rng: np.random.Generator) -> None:
    rays, distances = sphere_pixels()
    sigma, draws = rng.uniform(0.3, 0.9, distances.size), 1500
    off, squared, radii = [], 0.0, []
    start = CENTRES[0] + [4.0, -3.0, 5.0]
    for _ in range(draws):
        points = PINHOLE + (distances + sigma * rng.standard_normal(distances.size))[:, None] * rays
        fit = fit_sphere(points, sigma, PINHOLE, start, RADIUS, INCIDENCE_LIMIT)
        assert fit is not None
        off.append(fit.centre - CENTRES[0])
        squared += float(off[-1] @ np.linalg.solve(fit.covariance, off[-1])) / 3.0
        radii.append((fit.radius - RADIUS) / fit.radius_sigma)
    # A mean over 1500 draws has a standard deviation of 0.026 sigma; three times that stays below the tenth.
    assert np.all(np.abs(np.mean(off, axis=0)) < 0.1 * np.std(off, axis=0))
    # Covariances are multiplied by chi-squares above 1, on average by 1 + 0.4 sqrt(2 / 450) = 1.027; the mean
    # over the draws has a standard deviation of sqrt(2 / 4500) = 0.021.
    assert 1 / 1.027 - 0.065 < squared / draws < 1.0 + 0.065
    # The free radius: standard deviation to 1.8 %, three of them, and half of the 2.7 %.
    assert 1 / 1.014 - 0.055 < np.std(radii) < 1.055


def test_points_far_off_change_nothing_but_their_number(rng: np.random.Generator) -> None:
    rays, distances = sphere_pixels()
    sigma = np.full(distances.size, 0.2)
    measured = distances + sigma * rng.standard_normal(distances.size)
    bad = rng.random(distances.size) < 0.3
    measured[bad] += rng.choice([-12.0, 12.0], np.count_nonzero(bad))
    points = PINHOLE + measured[:, None] * rays
    fit = fit_sphere(points, sigma, PINHOLE, CENTRES[0] + [4.0, -3.0, 5.0], RADIUS, INCIDENCE_LIMIT)
    alone = fit_sphere(points[~bad], sigma[~bad], PINHOLE, CENTRES[0], RADIUS, INCIDENCE_LIMIT)
    assert fit is not None
    assert alone is not None
    # The median of magnitudes is larger by 30 % outliers, and with it the limit: a point in a thousand.
    assert fit.centre == pytest.approx(alone.centre, abs=0.2 * float(np.sqrt(alone.covariance.max())))
    assert not (fit.inlier & bad).any()
    assert np.count_nonzero(fit.front) + np.count_nonzero(fit.behind) >= np.count_nonzero(bad & ~fit.limb)


def test_residuals_along_rays_have_their_derivatives() -> None:
    rays, distances = sphere_pixels(0.8 * RADIUS)  # clear of the limb, where derivatives grow without limit
    offset, step = CENTRES[0] - PINHOLE, 1e-4
    residual, slope, _ = ray_residuals(rays, distances, offset, 0.8 * RADIUS)
    assert np.abs(residual).max() < 1e-7  # distances of 1100 mm, roots at the limb: half the digits
    residual, slope, sine = ray_residuals(rays, distances, offset, RADIUS)
    for k in range(4):
        ends = []
        for sign in (-step, step):
            moved = offset + sign * np.eye(4)[k, :3]
            ends.append(ray_residuals(rays, distances, moved, RADIUS + sign * (k == 3))[0])
        # Third derivatives of some 1 / R^2 leave 1e-11; rounding of 2e-13 mm over 2e-4 leaves 1e-9.
        assert slope[:, k] == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-7)
    assert sine.max() <= 0.8 + 1e-9


def test_points_seen_obliquely_are_left_out_by_their_rays_alone(rng: np.random.Generator) -> None:
    search = find_spheres(two_spheres().points(0.3, rng), 0.3, RADIUS, PINHOLE)
    for sphere in search.spheres:
        to = sphere.centre - PINHOLE
        rays = RAYS[tuple(sphere.pixels.T)]
        sine = np.linalg.norm(np.cross(rays, to), axis=1) / RADIUS
        assert sine.max() <= sin(INCIDENCE_LIMIT)
        # Of the disc, a quarter is beyond 60 degrees; a pixel more or less along its edge.
        part = sphere.refused["seen too obliquely"] / (
            sphere.refused["seen too obliquely"] + len(sphere.pixels)
        )
        assert part == pytest.approx(0.25, abs=0.03)


def test_a_half_seen_sphere_is_measured_without_bias(rng: np.random.Generator) -> None:
    squared = []
    for _ in range(12):
        points = two_spheres().points(0.3, rng)
        points[:, :, : int(project(CAMERA, POSE, CENTRES[0])[0])] = np.nan
        search = find_spheres(points, 0.3, RADIUS, PINHOLE)
        assert len(search.spheres) == 2
        assert 0.4 < search.spheres[0].coverage <= 0.75  # half, and the cells that the cut goes through
        squared += in_standard_deviations(search)
    # 24 spheres of 3 degrees of freedom, to four standard deviations.
    assert np.mean(squared) / 3.0 == pytest.approx(1.0, abs=4 * np.sqrt(2 / 72))


def test_a_region_limits_the_search(rng: np.random.Generator) -> None:
    points = cluttered().points(0.3, rng)
    region = np.zeros((SIZE, SIZE), dtype=bool)
    for centre in CENTRES:
        to = centre - PINHOLE
        region |= to @ to - (RAYS @ to) ** 2 < (RADIUS + 15.0) ** 2
    whole = find_spheres(points, 0.3, RADIUS, PINHOLE, layout=BAR)
    reduced = find_spheres(points, 0.3, RADIUS, PINHOLE, layout=BAR, region=region)
    assert reduced.problems == whole.problems == ()
    assert reduced.searched_fraction == pytest.approx(region.mean())
    for a, b in zip(whole.spheres, reduced.spheres, strict=True):
        # The same pixels, but for clutter around, decide: the fit stops at 1e-9 of the radius.
        assert a.centre == pytest.approx(b.centre, abs=1e-6)
    region[:, : SIZE // 2] = False
    half = find_spheres(points, 0.3, RADIUS, PINHOLE, layout=SphereLayout(predicted=CENTRES), region=region)
    assert [sphere.number for sphere in half.spheres] == [2]
    assert any("1 of 2 spheres" in problem for problem in half.problems)


def test_results_do_not_depend_on_threads(rng: np.random.Generator) -> None:
    points = cluttered().points(0.3, rng)
    one, two = (find_spheres(points, 0.3, RADIUS, PINHOLE, threads=threads) for threads in (1, 2))
    assert [s.centre.tolist() for s in one.spheres] == [s.centre.tolist() for s in two.spheres]
    assert one.refused == two.refused


def test_a_cloud_that_moves_takes_its_spheres_along(rng: np.random.Generator) -> None:
    points, shift = cluttered().points(0.3, rng), np.array([700.0, -300.0, 40.0])
    here = find_spheres(points, 0.3, RADIUS, PINHOLE)
    there = find_spheres(points + shift[:, None, None], 0.3, RADIUS, PINHOLE + shift)
    for a, b in zip(here.spheres, there.spheres, strict=True):
        assert b.centre == pytest.approx(a.centre + shift, abs=1e-6)  # votes fall into other cells


@pytest.mark.parametrize("swap", [False, True])
def test_spheres_are_numbered_by_prediction(swap: bool, rng: np.random.Generator) -> None:
    points = two_spheres().points(0.3, rng)
    order = CENTRES[::-1] if swap else CENTRES
    predicted = order + 10.0 * rng.standard_normal((2, 3))
    search = find_spheres(points, 0.3, RADIUS, PINHOLE, layout=SphereLayout(predicted=predicted))
    assert search.problems == ()
    for sphere, centre, where in zip(search.spheres, order, predicted, strict=True):
        assert np.linalg.norm(sphere.centre - centre) < 1.0
        assert sphere.off_prediction_mm == pytest.approx(float(np.linalg.norm(sphere.centre - where)))


def test_without_prediction_a_direction_numbers_them() -> None:
    points = two_spheres().points()
    for along, first in (((1.0, 0.0, 0.0), 0), ((-1.0, 0.0, 0.0), 1), ((0.0, 0.0, 1.0), 1)):
        search = find_spheres(points, 0.1, RADIUS, PINHOLE, layout=SphereLayout(order_along=along))
        assert search.spheres[0].centre == pytest.approx(CENTRES[first], abs=1e-6)
        assert np.isnan(search.spheres[0].off_prediction_mm)


def test_doubtful_numbers_and_far_predictions_are_told() -> None:
    points, middle = two_spheres().points(), CENTRES.mean(axis=0)
    across = np.cross(CENTRES[1] - CENTRES[0], [0.0, 0.0, 1.0]) / 2
    layout = SphereLayout(predicted=np.array([middle + across, middle - across]))
    search = find_spheres(points, 0.1, RADIUS, PINHOLE, layout=layout)
    assert any("numbers are doubtful" in problem for problem in search.problems)
    assert sum("from its predicted centre" in problem for problem in search.problems) == 2


def test_a_wrong_bar_length_is_told() -> None:
    points = two_spheres().points()
    search = find_spheres(points, 0.1, RADIUS, PINHOLE, layout=SphereLayout(bar_length_mm=1.02 * LENGTH))
    assert any("mm apart, not" in problem for problem in search.problems)
    assert len(search.spheres) == 2


def test_the_length_tells_the_bar_from_a_third_sphere() -> None:
    points = two_spheres().sphere(np.array([0.0, 200.0, -250.0])).points()
    search = find_spheres(points, 0.1, RADIUS, PINHOLE, layout=BAR)
    assert search.problems == ()
    assert search.refused["another sphere"] == 1
    assert search.separation_mm == pytest.approx(LENGTH, abs=1e-8)
    by_prediction = find_spheres(points, 0.1, RADIUS, PINHOLE, layout=SphereLayout(predicted=CENTRES + 5.0))
    assert by_prediction.separation_mm == pytest.approx(LENGTH, abs=1e-8)
    assert any("3 spheres" in p for p in find_spheres(points, 0.1, RADIUS, PINHOLE).problems)


@pytest.mark.parametrize("factor", [0.85, 1.2])
def test_spheres_of_another_radius_are_refused(factor: float, rng: np.random.Generator) -> None:
    search = find_spheres(two_spheres().points(0.3, rng), 0.3, factor * RADIUS, PINHOLE)
    assert search.spheres == ()
    assert any("0 of 2 spheres" in problem for problem in search.problems)
    assert sum(search.refused.values()) >= 2


@pytest.mark.parametrize("sigma", [0.02, 0.5, 3.0])
def test_things_that_are_no_spheres_are_refused(sigma: float, rng: np.random.Generator) -> None:
    cloud = nothing().plane(np.array([0.0, 0.0, 300.0]), np.array([0.2, 0.1, 1.0]))
    for k in range(5):
        start = np.array([-300.0, -250.0 + 120.0 * k, 20.0 * k])
        cloud = cloud.cylinder(start, start + np.array([600.0, 30.0 * k, 100.0]), RADIUS)
    search = find_spheres(cloud.points(sigma, rng), sigma, RADIUS, PINHOLE)
    assert search.spheres == ()
    assert np.isnan(search.separation_mm)


def test_an_empty_cloud_has_no_spheres() -> None:
    search = find_spheres(nothing().points(), 0.1, RADIUS, PINHOLE)
    assert search.spheres == ()
    assert any("0 of 2 spheres" in problem for problem in search.problems)


def test_points_without_standard_deviation_are_left_out_and_counted() -> None:
    points = two_spheres().points()
    sigma = np.full((SIZE, SIZE), 0.1, dtype=np.float32)
    sigma[::2] = np.nan
    search = find_spheres(points, sigma, RADIUS, PINHOLE)
    for sphere in search.spheres:
        assert (sphere.pixels[:, 0] % 2 == 1).all()
        assert sphere.refused["no standard deviation"] > 0.4 * len(sphere.pixels)


def test_votes_of_a_sphere_meet_in_its_centre() -> None:
    peaks = sphere_peaks(cluttered().points(), np.ones((SIZE, SIZE), dtype=bool), PINHOLE, RADIUS, 8)
    for centre in CENTRES:
        # Slopes over 5 px on a sphere 29 px across are off by its third derivatives, to the same side as
        # the surface bends on all sides: the mean stays within a tenth of the radius.
        assert min(np.linalg.norm(peak.centre - centre) for peak in peaks) < 0.1 * RADIUS
    for i, peak in enumerate(peaks):
        assert all(np.linalg.norm(peak.centre - other.centre) >= RADIUS for other in peaks[:i])


@pytest.mark.parametrize("limit", [1, 40, 333, 5000])
def test_chosen_pixels_are_spread_over_all(limit: int) -> None:
    y, x = np.mgrid[-30:31, -30:31]
    pixels = (np.argwhere(x**2 + y**2 <= 900) + 100).astype(np.int32)
    chosen = spread_pixels(pixels, limit)
    assert len(np.unique(chosen)) == len(chosen) <= limit
    if limit in (40, 333):
        # A grid cannot fill a disc evenly: squares at its edge are cut.
        assert len(chosen) > 0.7 * limit
        off = np.linalg.norm(pixels[:, None] - pixels[chosen], axis=-1).min(axis=1)
        # No pixel is farther than the diagonal of a square from a chosen one.
        assert off.max() <= np.sqrt(2.0 * 1.4 * len(pixels) / limit) + 1.0
    if limit == 5000:
        assert len(chosen) == len(pixels)


def test_as_many_points_are_selected_as_asked_for(rng: np.random.Generator) -> None:
    search = find_spheres(two_spheres().points(0.3, rng), 0.3, RADIUS, PINHOLE, select=100)
    for sphere in search.spheres:
        assert 70 <= len(sphere.selected) <= 100
        assert sphere.selected.max() < len(sphere.pixels)


def test_arrays_that_do_not_belong_together_are_refused() -> None:
    points = nothing().points()
    with pytest.raises(InvalidInput, match="shape"):
        find_spheres(points[0], 0.1, RADIUS, PINHOLE)
    with pytest.raises(InvalidInput, match="standard deviations"):
        find_spheres(points, np.ones((3, 3)), RADIUS, PINHOLE)
    with pytest.raises(InvalidInput, match="region"):
        find_spheres(points, 0.1, RADIUS, PINHOLE, region=np.ones((3, 3), dtype=bool))
    with pytest.raises(InvalidInput, match="selected"):
        find_spheres(points, 0.1, RADIUS, PINHOLE, select=0)
    with pytest.raises(InvalidInput, match="incidence"):
        find_spheres(points, 0.1, RADIUS, PINHOLE, incidence_limit=2.0)
    with pytest.raises(InvalidInput, match="above 0 mm"):
        find_spheres(points, 0.1, 0.0, PINHOLE)
    with pytest.raises(InvalidInput, match="predicted"):
        SphereLayout(predicted=np.zeros((3, 3)))
    with pytest.raises(InvalidInput, match="bar"):
        SphereLayout(count=3, bar_length_mm=100.0)


def test_a_narrower_limit_of_incidence_takes_fewer_points(rng: np.random.Generator) -> None:
    points = two_spheres().points(0.3, rng)
    wide, narrow = (
        find_spheres(points, 0.3, RADIUS, PINHOLE, incidence_limit=radians(a)).spheres[0] for a in (60, 40)
    )
    # By the areas of the discs, to a pixel along the edge.
    assert len(narrow.pixels) / len(wide.pixels) == pytest.approx(
        (sin(radians(40)) / sin(radians(60))) ** 2, abs=0.05
    )
    assert narrow.covariance[2, 2] > wide.covariance[2, 2]


def test_three_special_poses_tell_where_to_look_in_the_others(rng: np.random.Generator) -> None:
    towards_camera = np.array([[0.0, 0.1, 1.0], [0.1, 1.0, -0.1], [-1.0, 0.1, 0.0]])
    rotation = np.linalg.svd(towards_camera)[0] @ np.linalg.svd(towards_camera)[2]  # the nearest rotation
    bar = np.array([[120.0, 0.0, -180.0], [120.0, 0.0, 220.0]])
    stage = Stage(rotation, np.array([5.0, 10.0, 60.0]), bar, None, 0.0, pi / 2)
    sigma = 0.3

    def cloud_of(pan: float, tilt: float) -> Floats:
        first, second = predict_centres(stage, pan, tilt)
        wall = nothing().plane(np.array([0.0, 0.0, 500.0]), np.array([0.2, 0.1, 1.0]))
        return wall.sphere(first).sphere(second).cylinder(first, second, 10.0).points(sigma, rng)

    angles = np.array([[0.0, 0.0], [0.7, 0.0], [0.0, -0.6]])
    long_bar = SphereLayout(bar_length_mm=400.0)
    special = [find_spheres(cloud_of(*pose), sigma, RADIUS, PINHOLE, layout=long_bar) for pose in angles]
    centres = np.array([[s.centre for s in search.spheres] for search in special])
    covariances = np.array([[s.covariance for s in search.spheres] for search in special])
    numbered = np.array([centres[0], *label_special_poses(*centres, 0.7, -0.6)])
    for k in (1, 2):
        if not np.array_equal(numbered[k], centres[k]):
            covariances[k] = covariances[k, ::-1].copy()
    centres = numbered
    start, _ = stage_from_special_poses(*centres, 0.7, -0.6)
    fit = refine_stage(start, angles, centres, covariances)
    order = 1 if np.linalg.norm(centres[0, 0] - predict_centres(stage, 0, 0)[0]) < 1.0 else -1

    for pan, tilt in ((-0.7, 0.5), (1.2, -0.4), (0.3, 0.6)):
        predicted = predict_centres(fit.stage, pan, tilt)
        margin = search_margin_mm(prediction_covariance(fit.stage, pan, tilt))
        region = sphere_regions(CAMERA, POSE, (SIZE, SIZE), predicted, RADIUS, margin + 10.0)
        search = find_spheres(
            cloud_of(pan, tilt),
            sigma,
            RADIUS,
            PINHOLE,
            layout=SphereLayout(bar_length_mm=400.0, predicted=predicted),
            region=region,
        )
        assert search.problems == ()
        assert search.searched_fraction < 0.05
        true = predict_centres(stage, pan, tilt)[::order]
        for sphere, centre in zip(search.spheres, true, strict=True):
            off = sphere.centre - centre
            # 1 in 10,000 of chi-square with 3 degrees is above 21.
            assert off @ np.linalg.solve(sphere.covariance, off) < 21.0
            assert sphere.off_prediction_mm < margin + 1.0
