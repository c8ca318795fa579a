"""What the calibration's factor says of points, and of what is made of them, against drawn calibrations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.two_cameras import Floats, cameras

from sms_jobs.metrology.calibration.pair_points import moved_sensor
from sms_jobs.metrology.calibration.point_factor import (
    KnownView,
    economical,
    line_sigma_px,
    motion_factor,
    point_factor,
    sigma_of,
    square_root,
    turns,
)
from sms_jobs.metrology.deformation.strain.common_errors import (
    directional,
    mean_slopes,
    strain_factor,
    tangents,
)
from sms_jobs.metrology.deformation.strain.gauges import GaugePlace, read_gauge
from sms_jobs.metrology.deformation.strain.tangent_plane import surface_strain
from sms_jobs.metrology.geometry.camera import PER_SENSOR, Camera, pixel_grid, project, ray_directions
from sms_jobs.metrology.geometry.several_cameras import meet_rays
from sms_jobs.metrology.geometry.triangulation import Projector, triangulate
from sms_jobs.metrology.phase.patterns import phase_gradient

DRAWS = 800
# A standard deviation of n draws scatters by 1 / sqrt(2 n), 2.5 %: four of those.
WITHIN = 4.0 / np.sqrt(2.0 * DRAWS)
ROWS, COLUMNS = 16, 20
GAUGE_MM, X_AXIS = 20.0, (0.8, 0.0, 0.6)
PLACE = GaugePlace(0.0, 0.0, 60.0, 50.0, 0.3)
STRETCH = np.array([[0.01, 0.004, 0.0], [0.0, -0.006, 0.002], [0.01, 0.0, 0.0]])
SHIFT = np.array([0.5, 1.0, 4.0])


@dataclass(frozen=True)
class Rig:
    """Sensors, and which of them show fringes in which orientations."""

    sensors: tuple[Camera, ...]
    orientations: tuple[float, ...] = ()

    def seen(self, world: Floats) -> list[Floats]:
        """Return the pixels (n, 2) in which each sensor sees points (n, 3), without noise."""
        return [project(one.intrinsics, one.pose, world) for one in self.sensors]

    def measured(self, sensors: tuple[Camera, ...], pixels: list[Floats]) -> Floats:
        """Return what other sensors make of the pixels in which these see points."""
        camera, *partners = sensors
        if not self.orientations:
            places = np.stack([each.T for each in pixels[1:]])
            return meet_rays(camera, partners, pixels[0].T, places, np.full_like(places, 0.02)).xyz.T
        rays = ray_directions(camera.intrinsics, camera.pose, pixels[0])[None]
        size = partners[0].columns, partners[0].rows
        omega = np.stack([phase_gradient(pixels[1], *size, a)[None] for a in self.orientations])
        projector = Projector(partners[0].intrinsics, partners[0].pose, *size)
        sigma = np.full(omega.shape, 1e-3, np.float32)
        return triangulate(camera.pose.centre(), rays, projector, self.orientations, omega, sigma).xyz[:, 0].T


RIGS = {
    "two orientations": Rig(cameras(), (0.0, np.pi / 2)),
    "one orientation": Rig(cameras(), (0.3,)),
    "two cameras": Rig(cameras()),
    "three cameras": Rig(cameras(count=3)),
}


def points(camera: Camera) -> Floats:
    """Return points (rows, columns, 3) of a curved, tilted surface behind pixels of a camera."""
    grid = pixel_grid(ROWS, COLUMNS) * 12.0 + [80.0, 60.0]
    rays, centre = ray_directions(camera.intrinsics, camera.pose, grid), camera.pose.centre()
    along = np.full(grid.shape[:2], 600.0)
    for _ in range(40):
        at = centre + along[..., None] * rays
        height = 0.2 * at[..., 0] - at[..., 0] ** 2 / 400.0
        along -= (at[..., 2] - height) / (rays[..., 2] - 0.2 * rays[..., 0])
    return np.asarray(centre + along[..., None] * rays)


def covariance(sensors: int, seed: int = 5) -> Floats:
    """Return a covariance in which everything goes together: 20 urad, 20 um, 0.1 px, distortion 1e-4."""
    each = np.zeros(PER_SENSOR)
    each[:3], each[3:6], each[6:10], each[10:12], each[12:14] = 2e-5, 0.02, 0.1, 1e-4, 1e-5
    mixed = np.random.default_rng(seed).normal(size=(PER_SENSOR * sensors,) * 2)
    root = np.tile(each, sensors)[:, None] * mixed / np.sqrt(len(mixed))
    return root @ root.T


def known(rig: Rig, name: str = "one", seed: int = 5) -> KnownView:
    root = square_root(covariance(len(rig.sensors), seed))
    return KnownView(rig.sensors, name, root, rig.orientations)


def drawn(view: KnownView, random: np.random.Generator) -> tuple[Camera, ...]:
    steps = (view.root @ random.standard_normal(view.root.shape[1])).reshape(-1, PER_SENSOR)
    moved = [
        moved_sensor((one.intrinsics, one.pose), step) for one, step in zip(view.sensors, steps, strict=True)
    ]
    return tuple(
        replace(one, intrinsics=lens, pose=pose)
        for one, (lens, pose) in zip(view.sensors, moved, strict=True)
    )


def image(world: Floats) -> Floats:
    """Return points (n, 3) as a field (3, rows, columns)."""
    return np.ascontiguousarray(world.T.reshape(3, ROWS, COLUMNS))


LABELS = np.ones((ROWS, COLUMNS), np.int32)
UNDER = np.zeros_like(LABELS)
"""Smaller than the gauge, whose reading is that of the same material with every calibration."""
UNDER[4:12, 6:15] = 1
NO_NOISE = np.ones((6, ROWS, COLUMNS))
MIDDLE = np.array([ROWS // 2]), np.array([COLUMNS // 2])


def results(first: Floats, last: Floats) -> Floats:
    """Return what is made of points (n, 3) of two states: some of each, as one list of numbers."""
    xyz, moved = image(first), image(last - first)
    strain = surface_strain(xyz, moved, NO_NOISE, LABELS, gauge_length=GAUGE_MM, x_axis=X_AXIS).strain
    gauge = read_gauge(PLACE, xyz, moved, NO_NOISE, UNDER)
    length = np.linalg.norm(last[-1] - last[0]) - np.linalg.norm(first[-1] - first[0])
    return np.concatenate(
        [
            first[::53].ravel(),
            (last - first)[::53].ravel(),
            first.mean(axis=0),
            (last - first).mean(axis=0),
            (first[-1] - first[0]),
            [length],
            strain[:, MIDDLE[0][0], MIDDLE[1][0]],
            [gauge.strain],
        ]
    )


def stated(view: KnownView, first: Floats, last: Floats) -> Floats:
    """Return what the factor says of `results`."""
    at_rest, moved = point_factor(view, first), motion_factor(view, view, first, last - first)
    xyz, displacement = image(first), image(last - first)
    surface = tangents(xyz, displacement, LABELS, MIDDLE, radius=0.5 * GAUGE_MM, reach_px=4, x_axis=X_AXIS)

    def slopes(at: Floats, along: Floats) -> Floats:
        return directional(lambda p: point_factor(view, p), at, along, 0.25 * GAUGE_MM)

    strain = strain_factor(
        surface.axes,
        surface.stretched,
        slopes(surface.place, surface.axes),
        slopes(surface.moved, surface.stretched),
        X_AXIS,
    )
    gauge = read_gauge(PLACE, xyz, displacement, NO_NOISE, UNDER)
    under = gauge.under.ravel()
    before, after = (
        mean_slopes(factor[under], first[under], gauge.axes) for factor in (at_rest, at_rest + moved)
    )
    axis = (float(np.cos(PLACE.angle_rad)), float(np.sin(PLACE.angle_rad)), 0.0)
    read = strain_factor(gauge.axes[None], (gauge.axes + gauge.slopes)[None], before[None], after[None], axis)
    ends = [(p[-1] - p[0]) / np.linalg.norm(p[-1] - p[0]) for p in (last, first)]
    both = at_rest + moved
    length = ends[0] @ (both[-1] - both[0]) - ends[1] @ (at_rest[-1] - at_rest[0])
    columns = [
        at_rest[::53].reshape(-1, at_rest.shape[2]),
        moved[::53].reshape(-1, at_rest.shape[2]),
        at_rest.mean(axis=0),
        moved.mean(axis=0),
        at_rest[-1] - at_rest[0],
        length[None],
        strain[0],
        read[0, :1],
    ]
    return sigma_of(np.concatenate(columns))


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)
def test_what_drawn_calibrations_make_scatters_as_the_factor_says(rig: Rig) -> None:
    view = known(rig)
    first = points(rig.sensors[0]).reshape(-1, 3)
    last = first + first @ STRETCH.T + SHIFT
    random = np.random.default_rng(3)
    made, pixels = [], rig.seen(np.concatenate([first, last]))
    for _ in range(DRAWS):
        both = rig.measured(drawn(view, random), pixels)
        made.append(results(both[: len(first)], both[len(first) :]))
    scatter = np.sqrt(np.mean((np.array(made) - results(first, last)) ** 2, axis=0))
    np.testing.assert_allclose(scatter / stated(view, first, last), 1.0, atol=WITHIN)


@pytest.mark.parametrize("partner", [1, 2])
def test_images_miss_those_of_their_rays_by_what_drawn_calibrations_say(partner: int) -> None:
    """Held are the pixels in which the exact cameras see points; the line is that of a drawn pair."""
    rig = RIGS["three cameras"]
    view, random = known(rig), np.random.default_rng(4)
    world = points(rig.sensors[0]).reshape(-1, 3)[::40]
    pixels = [project(one.intrinsics, one.pose, world) for one in rig.sensors]
    far = np.linalg.norm(world - rig.sensors[0].pose.centre(), axis=1)[:, None]
    missed = []
    for _ in range(DRAWS):
        sensors = drawn(view, random)
        rays = ray_directions(sensors[0].intrinsics, sensors[0].pose, pixels[0])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        other = sensors[partner]
        line = [
            project(other.intrinsics, other.pose, sensors[0].pose.centre() + step * far * rays)
            for step in (1.0, 1.001)
        ]
        along = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0], axis=1, keepdims=True)
        missed.append(
            along[:, 0] * (pixels[partner] - line[0])[:, 1] - along[:, 1] * (pixels[partner] - line[0])[:, 0]
        )
    scatter = np.sqrt(np.mean(np.square(missed), axis=0))
    np.testing.assert_allclose(scatter / line_sigma_px(view, partner, world), 1.0, atol=WITHIN)


def test_a_root_is_that_of_its_covariance_and_of_what_is_held_there_is_none() -> None:
    made = covariance(2)
    root = square_root(made)
    # 14 of the 16 or so parameters of each of two sensors are free.
    assert root.shape[1] == np.count_nonzero(np.diag(made))
    scale = np.sqrt(np.outer(np.diag(made), np.diag(made)))
    np.testing.assert_allclose(root @ root.T, made, atol=1e-12 * scale.max())
    assert not root[np.diag(made) == 0.0].any()
    assert square_root(np.zeros((4, 4))).shape == (4, 0)


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)
def test_where_the_world_lies_cancels_in_a_displacement(rig: Rig) -> None:
    """All sensors shifted together shift points, and nothing else."""
    root = np.zeros((PER_SENSOR * len(rig.sensors), 3))
    for number, one in enumerate(rig.sensors):
        root[PER_SENSOR * number + 3 : PER_SENSOR * number + 6] = -one.pose.matrix()
    view = KnownView(rig.sensors, "shifts", root, rig.orientations)
    first = points(rig.sensors[0]).reshape(-1, 3)
    # The derivatives are sums of terms of up to 600 mm, in doubles.
    np.testing.assert_allclose(
        point_factor(view, first), np.broadcast_to(np.eye(3), (len(first), 3, 3)), atol=1e-9
    )
    displacement = np.full_like(first, 3.0)
    assert np.abs(motion_factor(view, view, first, displacement)).max() < 1e-9


def test_two_calibrations_are_independent_of_each_other() -> None:
    rig = RIGS["two orientations"]
    one, other = known(rig), known(rig, "other", 6)
    first = points(rig.sensors[0]).reshape(-1, 3)
    moved = sigma_of(motion_factor(one, other, first, np.full_like(first, 1.0)))
    ends = sigma_of(point_factor(other, first + 1.0)), sigma_of(point_factor(one, first))
    np.testing.assert_allclose(moved, np.hypot(*ends), rtol=1e-12)
    # With one calibration it all but cancels: 1 mm of 600 mm.
    assert (sigma_of(motion_factor(one, one, first, np.full_like(first, 1.0))) < 0.02 * ends[1]).all()


def test_columns_that_a_view_does_not_need_are_left_out() -> None:
    """A root of four sensors has more columns than two of them have parameters."""
    rig = RIGS["two orientations"]
    root = square_root(covariance(4))
    view = KnownView(rig.sensors, "one", root[: 2 * PER_SENSOR], rig.orientations)
    less = economical(view)
    assert less.root.shape[1] < root.shape[1]
    first = points(rig.sensors[0]).reshape(-1, 3)
    # But for the rounding of a singular value decomposition, of which strain, a small difference, sees most.
    np.testing.assert_allclose(
        sigma_of(point_factor(less, first)), sigma_of(point_factor(view, first)), rtol=1e-9
    )
    moved = [sigma_of(motion_factor(one, one, first, first @ STRETCH.T)) for one in (less, view)]
    np.testing.assert_allclose(moved[0], moved[1], rtol=1e-6)


def test_a_point_that_a_sensor_does_not_see_has_no_factor() -> None:
    for rig in RIGS.values():
        behind = np.array([[0.0, 0.0, 5000.0], [0.0, 0.0, 0.0]])
        found = point_factor(known(rig), behind)
        assert np.isnan(found[0]).all()
        assert np.isfinite(found[1]).all()


def coarser(rig: Rig) -> Rig:
    """Return a rig whose first partner has pixels of half the fineness."""
    camera, partner, *others = rig.sensors
    lens = partner.intrinsics
    half = replace(lens, fx=0.5 * lens.fx, fy=0.5 * lens.fy, cx=0.5 * lens.cx, cy=0.5 * lens.cy)
    return replace(rig, sensors=(camera, replace(partner, intrinsics=half), *others))


@pytest.mark.parametrize(
    "rig", [RIGS["two orientations"], RIGS["three cameras"], coarser(RIGS["two orientations"])]
)
def test_sensors_turn_about_their_centres_and_see_each_others_rays_a_pixel_off(rig: Rig) -> None:
    columns = turns(rig.sensors)
    assert columns.shape == (PER_SENSOR * len(rig.sensors), 2 * len(rig.sensors))
    for number, sensor in enumerate(rig.sensors):
        own = columns[PER_SENSOR * number : PER_SENSOR * (number + 1)]
        assert not np.delete(own, [2 * number, 2 * number + 1], axis=1).any()
        ahead = sensor.pose.centre() + 600.0 * sensor.pose.matrix()[2]
        was = project(sensor.intrinsics, sensor.pose, ahead[None])[0]
        finer = sensor.intrinsics.fx / rig.sensors[1].intrinsics.fx
        for column, moved in zip(
            own[:, 2 * number : 2 * number + 2].T, ([0.0, 1.0], [1.0, 0.0]), strict=True
        ):
            lens, pose = moved_sensor((sensor.intrinsics, sensor.pose), 0.1 * column)
            # Of second order: a turn of 0.1 px, 1e-4 rad, twice, by a metre.
            np.testing.assert_allclose(pose.centre(), sensor.pose.centre(), atol=2e-5)
            by = np.abs(project(lens, pose, ahead[None])[0] - was)
            np.testing.assert_allclose(by, 0.1 * finer * np.sqrt(0.5) * np.array(moved), atol=1e-3)
    view = KnownView(rig.sensors, "turned", columns, rig.orientations)
    seen = line_sigma_px(view, 1, points(rig.sensors[0]).reshape(-1, 3))
    # A turn moves more what is not ahead, by the square of the tangent: 0.05 at most.
    np.testing.assert_allclose(seen, 1.0, atol=0.12)


def test_what_a_view_has_of_its_own_is_kept_apart_from_what_is_common() -> None:
    rig = RIGS["two cameras"]
    place = points(rig.sensors[0]).reshape(-1, 3)
    shift = np.full_like(place, 0.2)
    random = np.random.default_rng(5)
    size = PER_SENSOR * len(rig.sensors)
    common = KnownView(rig.sensors, "known", 1e-4 * random.normal(size=(size, 3 * size)))
    turned = 0.1 * turns(rig.sensors)
    before, after = common.with_own(np.zeros_like(turned)), common.with_own(turned)
    whole = sigma_of(motion_factor(before, after, place, shift))
    parts = (
        sigma_of(motion_factor(common, common, place, shift)),
        sigma_of(point_factor(KnownView(rig.sensors, "turned", turned), place + shift)),
    )
    np.testing.assert_allclose(whole, np.hypot(*parts), rtol=1e-9)
    small = economical(before), economical(after)
    assert small[1].root.shape[1] == size + turned.shape[1]
    np.testing.assert_allclose(sigma_of(motion_factor(*small, place, shift)), whole, rtol=1e-6)
