"""Points of the virtual rig are laid back on their surface, as near as their noise lets expect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from support.bent_plate import CHORD_ERROR_MM, PLACEMENT, measured, plate_surface, seen_plate

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.metrology.calibration.rigid_alignment import rigid_modes
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import (
    compose,
    inverse,
    rotation_matrix,
    rotation_vector,
    transform,
    turn_covariance,
)
from sms_jobs.metrology.surfaces.coarse_registration import coarse_registration
from sms_jobs.metrology.surfaces.registration import MeasuredPoints, Registration, register
from sms_jobs.metrology.surfaces.triangle_surface import TriangleSurface, triangle_surface

TRUTH = inverse(PLACEMENT)  # world into the plate's own frame
SIGMA_MM = 0.05


@pytest.fixture(scope="module")
def plate() -> TriangleSurface:
    return triangle_surface(*plate_surface())


@pytest.fixture(scope="module")
def uneven() -> TriangleSurface:
    """A surface without any symmetry: 60 x 40 squares of 3 mm."""
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, 61), np.linspace(-1.0, 1.0, 41))
    bump = 6.0 * np.exp(-((u - 0.4) ** 2 + (v + 0.3) ** 2) / 0.1)
    z = 12.0 * np.cos(1.5 * u + 0.3) * np.sin(v) + 8.0 * u**2 + bump
    n = np.arange(u.size).reshape(u.shape)
    a, b, c, d = n[:-1, :-1], n[:-1, 1:], n[1:, 1:], n[1:, :-1]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return triangle_surface(np.column_stack([90.0 * u.ravel(), 60.0 * v.ravel(), z.ravel()]), faces)


def on_faces(
    surface: TriangleSurface, count: int, sigma: float, pose: Pose, rng: np.random.Generator
) -> MeasuredPoints:
    """Return noisy points on the surface, away from its rim, seen in the frame that `pose` brings back."""
    face = rng.integers(0, len(surface.faces), count)
    xyz = np.einsum("nk,nki->ni", rng.dirichlet((1, 1, 1), count), surface.vertices[surface.faces[face]])
    inside = (np.abs(xyz[:, 0]) < 85.0) & (np.abs(xyz[:, 1]) < 55.0)
    xyz, normals = xyz[inside], surface.face_normals[face[inside]]
    covariance = np.zeros((6, len(xyz)))
    covariance[[0, 3, 5]] = sigma**2
    back = inverse(pose)
    noisy = xyz + sigma * rng.normal(size=xyz.shape)
    return MeasuredPoints(transform(back, noisy), normals @ back.matrix().T, covariance)


def error_of(found: Registration, truth: Pose = TRUTH) -> np.ndarray:
    """Return by which small turn (rad) and shift (mm), in the surface's frame, the pose is off."""
    off = compose(found.pose, inverse(truth))
    return np.r_[rotation_vector(off.matrix()), off.translation]


def nudged(pose: Pose, turn: tuple[float, float, float], shift: tuple[float, float, float]) -> Pose:
    return compose(Pose.from_arrays(rotation_matrix(np.array(turn)), np.array(shift)), pose)


def test_exact_points_are_laid_where_they_come_from(
    uneven: TriangleSurface, rng: np.random.Generator
) -> None:
    truth = Pose.from_arrays(rotation_matrix(np.array([0.3, -1.1, 2.0])), np.array([30.0, -500.0, 900.0]))
    points = on_faces(uneven, 2000, 0.0, truth, rng)
    start = nudged(truth, (0.02, -0.03, 0.02), (2.0, -1.0, 1.5))
    found = register(uneven, points, start)
    assert found.converged
    assert found.held == 0
    # It stops once a step moves no point by more than 1e-6 mm; the part is 100 mm from its middle.
    error = error_of(found, truth)
    assert np.abs(error[:3]).max() < 1e-7
    assert np.abs(error[3:]).max() < 1e-5


def test_points_of_the_virtual_rig_are_within_their_noise(
    plate: TriangleSurface, rng: np.random.Generator
) -> None:
    start = nudged(TRUTH, (0.01, -0.015, 0.01), (3.0, 2.0, -2.0))
    found = register(plate, measured(seen_plate(), seen_plate().xyz, SIGMA_MM, rng), start)
    assert (found.converged, found.held) == (True, 0)
    # 1 but for what the robust spread of some 1000 points scatters by, 3 %: three of that.
    assert found.scale < 1.1
    error = error_of(found)
    square = error @ np.linalg.solve(found.covariance, error)
    # The chords of the reference are up to 9 um off the plate: at worst a shift along z besides the noise.
    bias = np.r_[np.zeros(5), CHORD_ERROR_MM]
    systematic = bias @ np.linalg.solve(found.covariance, bias)
    # In units of its own covariance the error is chi-square with 6 degrees of freedom; seldom beyond 0.999.
    assert np.sqrt(square) < np.sqrt(chi2.ppf(0.999, 6)) + np.sqrt(systematic)


def test_the_covariance_is_that_of_many_registrations(
    uneven: TriangleSurface, rng: np.random.Generator
) -> None:
    runs, squares = 60, []
    for _ in range(runs):
        found = register(uneven, on_faces(uneven, 700, 0.02, TRUTH, rng), TRUTH)
        error = error_of(found)
        squares.append(error @ np.linalg.solve(found.covariance, error))
    # The mean of 60 chi-squares with 6 degrees of freedom scatters by sqrt(12 / 60) = 0.45: four of these.
    assert abs(np.mean(squares) - 6.0) < 1.8


def test_a_dent_hardly_pulls_the_part(plate: TriangleSurface) -> None:
    depth, radius = 3.0, 20.0
    dent = seen_plate().dented(depth, radius, (60.0, 40.0))
    clean, dented = (
        measured(seen_plate(), xyz, SIGMA_MM, np.random.default_rng(3)) for xyz in (seen_plate().xyz, dent)
    )
    without, with_dent = (register(plate, points, TRUTH) for points in (clean, dented))
    normals = clean.normals @ TRUTH.matrix().T
    moved = transform(with_dent.pose, clean.xyz) - transform(without.pose, clean.xyz)
    along_normal = np.sum(moved * normals, axis=1)
    # The same noise: what differs is the pull of the dent. By linear theory plain least squares moves the
    # plate by J (J'J)^-1 J' times the dent. With the biweight only what is left of its rim pulls, less than
    # 4.7 sigma deep, over the mean slope of the biweight under noise, 0.76. Noise on the rim blurs that: half
    # as much again.
    exact = transform(TRUTH, seen_plate().xyz[:, np.isfinite(seen_plate().xyz).all(axis=0)].T)
    profile = np.sum((dent - seen_plate().xyz) * seen_plate().normal, axis=0)[
        np.isfinite(seen_plate().xyz).all(axis=0)
    ]
    gradient = np.einsum("ni,nij->nj", normals, rigid_modes(exact - exact.mean(axis=0)))
    plain = gradient @ np.linalg.lstsq(gradient, profile, rcond=None)[0]
    rim = profile * np.clip(1.0 - (profile / (4.685 * SIGMA_MM)) ** 2, 0.0, None) ** 2
    expected = gradient @ np.linalg.lstsq(gradient, rim, rcond=None)[0] / 0.76
    assert np.abs(along_normal).max() < 1.5 * np.abs(expected).max()
    assert np.abs(along_normal).max() < 0.2 * np.abs(plain).max()
    assert with_dent.used_fraction < without.used_fraction


def test_directions_that_the_surface_does_not_tell_are_held(rng: np.random.Generator) -> None:
    corners = np.array([[-50.0, -40.0, 0.0], [50.0, -40.0, 0.0], [50.0, 40.0, 0.0], [-50.0, 40.0, 0.0]])
    flat = triangle_surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    xy = rng.uniform(-30.0, 30.0, (500, 2))
    points = MeasuredPoints(
        np.column_stack([xy, 0.01 * rng.normal(size=500)]),
        np.tile([0.0, 0.0, 1.0], (500, 1)),
        np.tile(np.array([1e-4, 0, 0, 1e-4, 0, 1e-4])[:, None], 500),
    )
    start = nudged(Pose.from_arrays(np.eye(3), np.zeros(3)), (0.02, 0.01, 0.0), (1.0, 2.0, 0.5))
    found = register(flat, points, start)
    assert found.held == 3
    moved = transform(found.pose, points.xyz)
    # sigma / sqrt(n) = 0.0005 mm at the middle, and more at the edge: 5 sigma of 2 sigma / sqrt(n).
    assert abs(np.mean(moved[:, 2])) < 0.005
    # Turned upright without being pushed along: cos of the turn away, 50 mm * 0.02^2 / 2 = 0.01 mm.
    before = transform(start, points.xyz)
    np.testing.assert_allclose(moved[:, :2].mean(axis=0), before[:, :2].mean(axis=0), atol=0.02)
    np.testing.assert_allclose(found.covariance[[2, 3, 4]][:, [2, 3, 4]].diagonal(), 0.0, atol=1e-6)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_part_is_found_wherever_it_is(uneven: TriangleSurface, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = Pose.from_arrays(rotation_matrix(rng.normal(size=3) * 2.0), rng.normal(size=3) * 500.0)
    points = on_faces(uneven, 3000, 0.02, truth, rng)
    found = register(uneven, points, coarse_registration(uneven, points))
    error = error_of(found, truth)
    assert error @ np.linalg.solve(found.covariance, error) < chi2.ppf(0.9999, 6)


def test_a_surface_turned_inside_out_is_told(uneven: TriangleSurface, rng: np.random.Generator) -> None:
    points = on_faces(uneven, 500, 0.02, TRUTH, rng)
    with pytest.raises(MeasurementFailed, match="face the reference surface"):
        register(uneven, replace(points, normals=-points.normals), TRUTH)
    with pytest.raises(MeasurementFailed, match="face outwards"):
        coarse_registration(uneven, replace(points, normals=-points.normals[:, ::-1] * 0.0))
    with pytest.raises(InvalidInput, match="at least 1 iteration"):
        register(uneven, points, TRUTH, iterations=0)


def test_threads_and_frames_change_nothing(uneven: TriangleSurface, rng: np.random.Generator) -> None:
    points = on_faces(uneven, 2000, 0.02, TRUTH, rng)
    one, two = (register(uneven, points, TRUTH, threads=n) for n in (1, 2))
    np.testing.assert_array_equal(one.covariance, two.covariance)
    assert one.pose == two.pose
    turn = Pose.from_arrays(rotation_matrix(np.array([0.5, 0.2, -0.9])), np.array([10.0, 20.0, -30.0]))
    turned = MeasuredPoints(
        transform(turn, points.xyz),
        points.normals @ turn.matrix().T,
        turn_covariance(turn.matrix(), points.covariance),
    )
    again = register(uneven, turned, compose(TRUTH, inverse(turn)))
    # Both stop when a step is below a hundredth of sigma.
    apart = transform(again.pose, turned.xyz) - transform(one.pose, points.xyz)
    assert np.abs(apart).max() < 0.02 * np.sqrt(np.trace(one.covariance[3:, 3:])) + 1e-5
