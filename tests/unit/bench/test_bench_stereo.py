"""Errors of points from two cameras are what they are said to be, and the shifted plate is shifted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.bench.compared_fields import reported_over_observed
from sms_jobs.bench.two_cameras.errors import (
    PointErrors,
    displacement_errors,
    shape_errors,
)
from sms_jobs.bench.two_cameras.rigid_plates import (
    finely_recorded,
    search_range_px,
    shifted_plate,
    true_shift,
)
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.records.fields import DisplacementField, Surface
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.truth import Truth

COLUMNS, ROWS = 96, 80
SHIFT_MM = 10.0


def recorded() -> tuple[Shelf, Subject]:
    """Return a plate that was recorded at rest and shifted, and its shifted tuple."""
    _, campaign = shifted_plate("plate", COLUMNS, ROWS, (SHIFT_MM,))
    shelf = Shelf(campaign, 1)
    for state in ("S00", "S01"):
        shelf.record(Subject("plate", state, "C1C2"))
    return shelf, Subject("plate", "S01", "C1C2")


def surface(truth: Truth, off_mm: float, sigma_mm: float) -> Surface:
    """Return the exact shape, too far along z, with a standard deviation along z."""
    known = truth.shape.seen
    position = truth.shape.xyz.copy()
    position[2] += off_mm
    covariance = np.zeros((6, *known.shape), dtype=np.float32)
    covariance[5] = sigma_mm**2
    reason = np.where(known, 0, 1).astype(np.uint32)
    return Surface("C1C2", "mm", position, reason, covariance)


def test_the_plate_is_shifted_by_what_is_said() -> None:
    shelf, subject = recorded()
    truth = shelf.truth(subject)
    exact = true_shift(shelf.campaign, SHIFT_MM)
    assert np.linalg.norm(exact) == pytest.approx(SHIFT_MM)
    seen = truth.displacement[:, truth.shape.seen]
    np.testing.assert_allclose(seen, np.broadcast_to(exact[:, None], seen.shape), atol=1e-12)
    # It stays in the image, and seeds look far enough.
    assert shelf.campaign.scene is not None
    camera = shelf.campaign.scene.rig.sensor("C1")
    start = truth.shape.xyz[:, truth.shape.seen].T
    place, end = (project(camera.intrinsics, camera.pose, xyz) for xyz in (start, start + exact))
    assert np.abs(end - place).max() < search_range_px(shelf.campaign, SHIFT_MM)
    assert (end > 0.0).all()
    assert (end < [COLUMNS - 1, ROWS - 1]).all()


def test_finer_rays_see_the_same_plate() -> None:
    shelf, subject = recorded()
    fine = finely_recorded(shelf.campaign, subject, 1)
    for own in subject.recordings:
        plain, finer = (
            some[MEASUREMENT, own]["measurement"].texture.astype(np.float64) for some in (shelf.records, fine)
        )
        # No shift: it would leave the slope of the speckle, a third of the contrast a pixel.
        assert np.std(finer - plain) < 0.05 * np.std(plain)
        assert np.std(finer - plain) > 0.0


def test_errors_of_shape_are_lengths_sigmas_and_pixels() -> None:
    shelf, subject = recorded()
    truth = shelf.truth(subject)
    assert shelf.campaign.scene is not None
    partner = shelf.campaign.scene.rig.sensor("C2")
    # 0.3 mm along z, 10 degrees off C2's axis: 0.052 mm across it, and a pixel is 500 / (2.8 x 96) = 1.9 mm.
    found = shape_errors(surface(truth, 0.3, 0.1), truth.shape, partner)
    np.testing.assert_allclose(found.length_mm, 0.3)
    np.testing.assert_allclose(found.sigma_mm, 0.1, rtol=1e-6)
    assert np.median(found.seen_px) == pytest.approx(0.3 * np.sin(np.radians(10.0)) / 1.86, rel=0.1)
    # 3 sigma is no outlier, whatever it is in pixels, and 30 sigma only from 0.05 px on.
    assert found.outliers == 0
    precise = shape_errors(surface(truth, 0.3, 0.01), truth.shape, partner)
    assert precise.outliers == 0
    farther = shape_errors(surface(truth, 3.0, 0.01), truth.shape, partner)
    assert farther.outliers == len(farther.length_mm)
    assert found.valid_part == pytest.approx(
        truth.shape.seen.sum() / (truth.shape.seen & truth.shape.lit).sum()
    )


def test_what_lies_nowhere_is_an_outlier() -> None:
    shelf, subject = recorded()
    truth = shelf.truth(subject)
    assert shelf.campaign.scene is not None
    everywhere = surface(truth, 0.0, 0.1)
    beyond = replace(
        everywhere,
        position=np.nan_to_num(everywhere.position),
        reason=np.zeros_like(everywhere.reason),
    )
    found = shape_errors(beyond, truth.shape, shelf.campaign.scene.rig.sensor("C2"))
    assert found.outliers == np.count_nonzero(~truth.shape.seen) > 0
    assert np.isfinite(found.normalised).all()


def test_errors_of_displacement_are_those_of_its_end() -> None:
    shelf, subject = recorded()
    truth = shelf.truth(subject)
    assert shelf.campaign.scene is not None
    reason = np.where(truth.shape.seen, 0, 1).astype(np.uint32)
    moved = truth.displacement + np.array([0.0, 0.4, 0.0])[:, None, None]
    covariance = np.full((6, ROWS, COLUMNS), 0.01, dtype=np.float32)
    image = np.zeros((2, ROWS, COLUMNS))
    field = DisplacementField("C1C2", "S00", "mm", moved, covariance, image, reason, 0.0, 10)
    found = displacement_errors(field, truth, shelf.campaign.scene.rig.sensor("C2"))
    np.testing.assert_allclose(found.length_mm, 0.4)
    np.testing.assert_allclose(found.sigma_mm, np.sqrt(0.03), rtol=1e-6)
    # Up and down both cameras see it whole.
    assert np.median(found.seen_px) == pytest.approx(0.4 / 1.86, rel=0.1)


def test_honesty_is_one_over_the_rms() -> None:
    errors = PointErrors(
        np.array([1.0, 3.0, np.inf]), np.array([2.0, 2.0, 1.0]), np.array([0.0, 0.0, 1.0]), 4
    )
    assert reported_over_observed([errors.normalised]) == pytest.approx(1.0 / np.sqrt((0.25 + 2.25) / 2.0))
    assert errors.outliers == 1
    assert errors.valid_part == 0.75
