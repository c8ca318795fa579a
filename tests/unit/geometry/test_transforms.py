"""Rigid transforms form a group, and their matrices turn the way that is said."""

from __future__ import annotations

import cv2
import numpy as np

from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.planes import covariance_in_plane, trace
from sms_jobs.metrology.geometry.transforms import (
    compose,
    inverse,
    pack,
    rotation_from_angles,
    rotation_matrix,
    rotation_vector,
    transform,
    turn_covariance,
    unpack,
)

ROUNDING = 1e-12  # some roundings of numbers near 1, or of lengths near 1000 mm


def some_pose(rng: np.random.Generator) -> Pose:
    return Pose.from_arrays(rotation_matrix(rng.normal(size=3)), rng.normal(size=3) * 300.0)


def test_rotation_vectors_are_those_of_opencv(rng: np.random.Generator) -> None:
    vectors = rng.normal(size=(5, 4, 3))
    found = rotation_matrix(vectors)
    assert found.shape == (5, 4, 3, 3)
    for vector, matrix in zip(vectors.reshape(-1, 3), found.reshape(-1, 3, 3), strict=True):
        np.testing.assert_allclose(matrix, cv2.Rodrigues(vector)[0], atol=ROUNDING)


def test_rotation_vector_inverts_rotation_matrix(rng: np.random.Generator) -> None:
    for vector in rng.uniform(-1.7, 1.7, size=(20, 3)):  # all shorter than pi
        np.testing.assert_allclose(rotation_vector(rotation_matrix(vector)), vector, atol=1e-10)


def test_photogrammetric_angles_are_three_turns_about_the_axes() -> None:
    omega, phi, kappa = 0.3, -0.5, 0.9
    about_x = rotation_matrix(np.array([-omega, 0.0, 0.0]))
    about_y = rotation_matrix(np.array([0.0, -phi, 0.0]))
    about_z = rotation_matrix(np.array([0.0, 0.0, -kappa]))
    # With the printed row 2 of Eq. (1.24) this is not a rotation at all.
    np.testing.assert_allclose(
        rotation_from_angles(omega, phi, kappa), about_z @ about_y @ about_x, atol=ROUNDING
    )


def test_composition_applies_the_inner_transform_first(rng: np.random.Generator) -> None:
    a, b, points = some_pose(rng), some_pose(rng), rng.normal(size=(7, 3)) * 100.0
    np.testing.assert_allclose(
        transform(compose(a, b), points), transform(a, transform(b, points)), atol=1e3 * ROUNDING
    )


def test_the_inverse_undoes_a_transform(rng: np.random.Generator) -> None:
    pose, points = some_pose(rng), rng.normal(size=(7, 3)) * 100.0
    back = transform(inverse(pose), transform(pose, points))
    np.testing.assert_allclose(back, points, atol=1e3 * ROUNDING)


def test_packing_keeps_a_symmetric_tensor(rng: np.random.Generator) -> None:
    half = rng.normal(size=(4, 5, 3, 3))
    full = half + np.swapaxes(half, -1, -2)
    np.testing.assert_array_equal(unpack(pack(full)), full)


def test_a_covariance_turns_with_its_vectors(rng: np.random.Generator) -> None:
    vectors = rng.normal(size=(500, 3)) * [1.0, 2.0, 3.0]
    turn = rotation_matrix(np.array([0.4, -0.3, 1.1]))
    covariance = pack(np.cov(vectors.T))
    # The sample covariance of turned vectors is the turned sample covariance, up to rounding.
    np.testing.assert_allclose(
        turn_covariance(turn, covariance), pack(np.cov((vectors @ turn.T).T)), atol=1e-11
    )


def test_the_trace_is_that_of_the_full_tensor(rng: np.random.Generator) -> None:
    packed = rng.normal(size=(6, 4, 5)).astype(np.float32)
    found = trace(packed)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, np.trace(unpack(packed), axis1=-2, axis2=-1), atol=ROUNDING)
    np.testing.assert_allclose(trace(covariance_in_plane(packed)), found - packed[5], atol=ROUNDING)
