"""Triangulation: exact on exact phases, with the covariance that scatter shows."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import unpack
from sms_jobs.metrology.geometry.triangulation import (
    Projector,
    Triangulation,
    camera_rays,
    triangulate,
)
from sms_jobs.metrology.phase.patterns import phase_gradient

Floats = NDArray[np.float64]

ROWS, COLUMNS = 20, 26
UP = np.array([0.05, -1.0, 0.0])
CAMERA = Intrinsics(45.0, 46.0, 12.3, 9.8, -0.08, 0.05, 4e-4, -3e-4, 0.01)
CAMERA_POSE = Pose.looking_at(np.array([-400.0, 30.0, -1000.0]), np.zeros(3), UP)
PROJECTOR = Projector(
    Intrinsics(1900.0, 1890.0, 515.0, 390.0, -0.05, 0.03, -2e-4, 3e-4, 0.0),
    Pose.looking_at(np.array([420.0, -80.0, -1100.0]), np.array([5.0, 0.0, 0.0]), UP),
    1024,
    768,
)
CROSSED = (0.0, pi / 2)


@pytest.fixture
def scene(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Camera rays (rows, columns, 3), and a point on each, (rows, columns, 3) in mm."""
    rays = camera_rays(CAMERA, CAMERA_POSE, ROWS, COLUMNS)
    distances = rng.uniform(980.0, 1130.0, size=(ROWS, COLUMNS, 1))
    return rays, CAMERA_POSE.centre() + distances * rays


def phases(points: Floats, orientations: tuple[float, ...]) -> Floats:
    pixels = project(PROJECTOR.intrinsics, PROJECTOR.pose, points)
    return np.stack([phase_gradient(pixels, PROJECTOR.columns, PROJECTOR.rows, a) for a in orientations])


def meet(
    rays: Floats,
    omega: Floats,
    orientations: tuple[float, ...],
    sigma: float = 2e-4,
    towards: float = 0.0,
    threads: int = 1,
) -> Triangulation:
    return triangulate(
        CAMERA_POSE.centre(),
        rays,
        PROJECTOR,
        orientations,
        omega,
        np.full(omega.shape, sigma, np.float32),
        towards_projector=towards,
        threads=threads,
    )


@pytest.mark.parametrize("towards", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(
    "orientations", [CROSSED, (pi / 4, -pi / 4), (0.0, 1.0, 2.0), (0.0,), (0.3,)], ids=str
)
def test_exact_phases_give_the_exact_point(
    scene: tuple[Floats, Floats], orientations: tuple[float, ...], towards: float
) -> None:
    rays, points = scene
    found = meet(rays, phases(points, orientations), orientations, towards=towards)
    # The lens is inverted to 1e-12 of a metre's distance; the triangulation angle costs a factor of 2.
    np.testing.assert_allclose(np.moveaxis(found.xyz, 0, -1), points, atol=1e-6)
    np.testing.assert_allclose(found.ray_gap, 0.0, atol=1e-6)


def test_the_gap_is_the_distance_of_the_rays_and_the_points_lie_on_them(
    scene: tuple[Floats, Floats], rng: np.random.Generator
) -> None:
    rays, points = scene
    omega = phases(points, CROSSED) + rng.normal(scale=1e-2, size=(2, ROWS, COLUMNS))
    on_camera, midway, on_projector = (meet(rays, omega, CROSSED, towards=k) for k in (0.0, 0.5, 1.0))
    across = on_projector.xyz - on_camera.xyz
    # Single precision of the gap, some millimetres.
    np.testing.assert_allclose(np.linalg.norm(across, axis=0), np.abs(on_camera.ray_gap), rtol=1e-5)
    np.testing.assert_allclose(midway.xyz, 0.5 * (on_camera.xyz + on_projector.xyz), atol=1e-9)
    # The shortest way between two lines is normal to both.
    camera_ray = np.moveaxis(rays, -1, 0)
    projector_ray = on_projector.xyz - PROJECTOR.pose.centre()[:, None, None]
    np.testing.assert_allclose(np.sum(across * camera_ray, axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.sum(across * projector_ray, axis=0), 0.0, atol=1e-6)
    np.testing.assert_allclose(phases(np.moveaxis(on_projector.xyz, 0, -1), CROSSED), omega, atol=1e-9)


@pytest.mark.parametrize("towards", [0.0, 0.5])
@pytest.mark.parametrize("orientations", [CROSSED, (0.0, 1.0, 2.0), (0.3,)], ids=str)
def test_the_covariance_is_that_of_finite_differences(
    scene: tuple[Floats, Floats], rng: np.random.Generator, orientations: tuple[float, ...], towards: float
) -> None:
    rays, points = scene
    omega = phases(points, orientations)
    if len(orientations) > 1:  # off the exact phases, so that the gap's part is tested too
        omega += rng.normal(scale=3e-3, size=omega.shape)
    sigma, step = 2e-4, 1e-6
    expected = np.zeros((ROWS, COLUMNS, 3, 3))
    gap_variance = np.zeros((ROWS, COLUMNS))
    for k in range(len(orientations)):
        shift = np.zeros_like(omega)
        shift[k] = step
        high = meet(rays, omega + shift, orientations, towards=towards)
        low = meet(rays, omega - shift, orientations, towards=towards)
        slope = np.moveaxis(high.xyz - low.xyz, 0, -1) / (2.0 * step) * sigma
        expected += slope[..., :, None] * slope[..., None, :]
        gap_variance += ((high.ray_gap - low.ray_gap) / (2.0 * step) * sigma) ** 2
    found = meet(rays, omega, orientations, sigma, towards)
    # Differences are good to 1e-6 relative here, single precision to 1e-7 of the largest component.
    scale = np.trace(expected, axis1=-2, axis2=-1).max()
    np.testing.assert_allclose(unpack(found.covariance), expected, atol=1e-4 * scale)
    # The gap is single precision: 1e-7 of up to 5 mm over a difference of 2e-3 mm leaves 1e-3.
    np.testing.assert_allclose(found.ray_gap_sigma, np.sqrt(gap_variance), rtol=0.02, atol=1e-6)


def test_the_covariance_is_that_of_scatter(scene: tuple[Floats, Floats], rng: np.random.Generator) -> None:
    rays, points = scene
    exact, sigma, trials = phases(points, CROSSED), 2e-4, 60
    errors, gaps = [], []
    for _ in range(trials):
        noisy = meet(rays, exact + rng.normal(scale=sigma, size=exact.shape), CROSSED, sigma)
        errors.append(np.moveaxis(noisy.xyz, 0, -1) - points)
        gaps.append(noisy.ray_gap / noisy.ray_gap_sigma)
    predicted = np.sqrt(unpack(noisy.covariance)[..., range(3), range(3)])
    # 60 x 520 samples: the rms of a standard normal variable scatters by 1 / sqrt(2 n) = 0.4 %.
    ratio = np.sqrt(np.mean((np.array(errors) / predicted) ** 2, axis=(0, 1, 2)))
    np.testing.assert_allclose(ratio, 1.0, atol=0.02)
    assert np.std(gaps) == pytest.approx(1.0, abs=0.02)


def test_a_point_on_the_cameras_ray_scatters_less_than_one_half_way(
    scene: tuple[Floats, Floats], rng: np.random.Generator
) -> None:
    rays, points = scene
    omega = phases(points, CROSSED) + rng.normal(scale=2e-4, size=(2, ROWS, COLUMNS))

    def squared_error(towards: float) -> float:
        found = meet(rays, omega, CROSSED, towards=towards)
        return float(np.mean((np.moveaxis(found.xyz, 0, -1) - points) ** 2))

    assert squared_error(0.0) < squared_error(0.5)


@pytest.mark.parametrize("orientations", [CROSSED, (0.3,)], ids=str)
def test_a_part_of_the_variances_is_followed_into_the_covariance(
    scene: tuple[Floats, Floats], orientations: tuple[float, ...], rng: np.random.Generator
) -> None:
    rays, points = scene
    omega = phases(points, orientations)
    sigma = rng.uniform(1e-4, 3e-4, omega.shape).astype(np.float32)
    part = rng.random(omega.shape).astype(np.float32)
    told, alone = (
        triangulate(CAMERA_POSE.centre(), rays, PROJECTOR, orientations, omega, each, part=of)
        for each, of in ((sigma, part), (sigma * np.sqrt(part), None))
    )
    # Single precision, and covariances are quadratic in what is rounded.
    np.testing.assert_allclose(told.part * told.covariance, alone.covariance, rtol=1e-5, atol=1e-15)
    np.testing.assert_array_equal(alone.part, 0.0)


def test_rays_that_meet_behind_a_sensor_give_no_point(scene: tuple[Floats, Floats]) -> None:
    rays, points = scene
    found = meet(-rays, phases(points, CROSSED), CROSSED)
    assert np.isnan(found.xyz).all()
    assert np.isnan(found.covariance).all()
    assert np.isnan(found.ray_gap).all()
    assert np.isnan(meet(-rays, phases(points, (0.0,)), (0.0,)).xyz).all()


def test_a_missing_phase_gives_a_missing_point(scene: tuple[Floats, Floats]) -> None:
    rays, points = scene
    for orientations in (CROSSED, (0.0,)):
        omega = phases(points, orientations)
        omega[0, 3, 4] = np.nan
        missing = np.isnan(meet(rays, omega, orientations).xyz)
        assert missing[:, 3, 4].all()
        assert missing.sum() == 3


def test_threads_change_nothing() -> None:
    rays = camera_rays(CAMERA, CAMERA_POSE, 40, COLUMNS)  # more than one block of rows
    omega = phases(CAMERA_POSE.centre() + 1050.0 * rays, CROSSED)
    one, two = meet(rays, omega, CROSSED), meet(rays, omega, CROSSED, threads=2)
    np.testing.assert_array_equal(one.xyz, two.xyz)
    np.testing.assert_array_equal(one.covariance, two.covariance)


def test_parallel_orientations_are_refused(scene: tuple[Floats, Floats]) -> None:
    rays, points = scene
    with pytest.raises(InvalidInput, match="parallel"):
        meet(rays, phases(points, (0.0, pi)), (0.0, pi))
