"""Surfaces without a calibration: continuous pieces, filled holes, and normals towards the camera."""

from __future__ import annotations

import numpy as np
import pytest
from support.bent_plate import CAMERA, seen_plate

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.surfaces.continuity import continuous_labels, fill_small_holes, median_footprint
from sms_jobs.metrology.surfaces.meshing import triangulate_image
from sms_jobs.metrology.surfaces.normals import image_normals


def sheet(rows: int = 40, columns: int = 50) -> np.ndarray:
    """A surface that is quadratic in row and column."""
    y, x = np.mgrid[0:rows, 0:columns].astype(float)
    return np.stack([0.5 * x, -0.5 * y, 0.002 * x**2 - 0.003 * y**2 + 0.001 * x * y])


def test_the_footprint_is_the_size_of_a_pixel() -> None:
    xyz = sheet()
    valid = np.ones(xyz.shape[1:], bool)
    # Slopes of up to 0.35 lengthen one way more than the other: the smaller by sqrt(1 + 0.2^2), 2 %, at most.
    assert median_footprint(xyz, valid) == pytest.approx(0.5, rel=0.02)
    assert np.isnan(median_footprint(xyz, np.zeros_like(valid)))
    plate = seen_plate()
    known = np.isfinite(plate.xyz).all(axis=0)
    depth = np.linalg.norm(np.moveaxis(plate.xyz, 0, -1)[known] - CAMERA.pose.centre(), axis=1)
    expected = np.median(depth) / CAMERA.intrinsics.fx
    # The camera looks on the plate at 12 degrees, and it is bent by up to 40: the smaller of two slopes.
    assert median_footprint(plate.xyz, known) == pytest.approx(expected, rel=0.1)


def test_a_step_parts_what_is_continuous() -> None:
    xyz = sheet()
    xyz[2, :, 30:] += 10.0
    xyz[:, 5:8, 5:8] = np.nan
    labels = continuous_labels(xyz)
    assert set(np.unique(labels)) == {0, 1, 2}
    assert np.all(labels[:, :30][np.isfinite(xyz[0, :, :30])] == 1)
    assert np.all(labels[:, 30:] == 2)
    pixels, faces = triangulate_image(labels)
    joined = labels[tuple(pixels.T)][faces]
    assert np.all(joined.min(axis=1) == joined.max(axis=1))
    assert not continuous_labels(np.full((3, 5, 5), np.nan)).any()


def test_a_small_hole_is_filled_and_marked() -> None:
    whole, xyz = sheet(), sheet()
    hole = np.zeros(xyz.shape[1:], bool)
    hole[10:13, 20:24] = True
    hole[11, 24] = True
    xyz[:, hole] = np.nan
    labels = np.where(hole, 0, 1).astype(np.int32)
    found = fill_small_holes(xyz, labels, 13)
    assert found.holes == 1
    np.testing.assert_array_equal(found.filled, hole)
    assert (found.labels == 1).all()
    # What is quadratic is filled exactly: rounding of a fit to some 100 points of up to 25 mm.
    np.testing.assert_allclose(found.xyz[:, hole], whole[:, hole], atol=1e-11)
    np.testing.assert_array_equal(found.xyz[:, ~hole], xyz[:, ~hole])
    assert np.isnan(xyz[:, hole]).all()  # what was given stays as it was


def test_other_gaps_stay_open() -> None:
    xyz = sheet()
    labels = np.ones(xyz.shape[1:], np.int32)
    labels[:, 25:] = 2
    gaps = np.zeros_like(labels, bool)
    gaps[0:2, 5:7] = True  # at the edge of the image
    gaps[20:22, 24:26] = True  # between two regions
    gaps[30:36, 5:11] = True  # too large
    labels[gaps] = 0
    xyz[:, gaps] = np.nan
    found = fill_small_holes(xyz, labels, 20)
    assert found.holes == 0
    np.testing.assert_array_equal(found.labels, labels)
    assert fill_small_holes(xyz, labels, 36).holes == 1
    assert fill_small_holes(xyz, labels, 0).holes == 0
    with pytest.raises(InvalidInput, match="0 px or more"):
        fill_small_holes(xyz, labels, -1)


def test_the_noise_of_a_filled_hole_is_that_of_its_rim(rng: np.random.Generator) -> None:
    whole = sheet()
    hole = np.zeros(whole.shape[1:], bool)
    hole[10:12, 20:22] = True
    labels = np.where(hole, 0, 1).astype(np.int32)
    errors = []
    for _ in range(50):
        noisy = whole + 0.01 * rng.normal(size=whole.shape)
        noisy[:, hole] = np.nan
        errors.append(fill_small_holes(noisy, labels, 4).xyz[:, hole] - whole[:, hole])
    # Six coefficients of a ring of some 40 pixels: within it the fit is better than a pixel.
    assert np.sqrt(np.mean(np.square(errors))) < 0.01


def test_normals_are_those_of_the_surface_and_point_to_the_camera(rng: np.random.Generator) -> None:
    plate = seen_plate()
    labels = np.isfinite(plate.xyz).all(axis=0).astype(np.int32)
    normals = image_normals(plate.xyz + 0.05 * rng.normal(size=plate.xyz.shape), labels)
    known = np.isfinite(normals).all(axis=0)
    assert known.sum() > 0.95 * labels.sum()
    np.testing.assert_allclose(np.linalg.norm(normals[:, known], axis=0), 1.0, atol=1e-12)
    cosine = np.sum(normals * plate.normal, axis=0)[known]
    # A pixel is 8 mm: over 5 of them the plate turns by up to 0.36 rad, and at the rim one side is missing.
    assert np.degrees(np.arccos(np.median(cosine))) < 5.0
    assert cosine.min() > 0.5
