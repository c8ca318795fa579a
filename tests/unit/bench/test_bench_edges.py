"""Displacement near a hole and a step: right up to them with regions, not without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.bench.studies.edges import (
    WAYS,
    Profile,
    distance_from_edges,
    exact_image_displacement,
    profiles,
)
from sms_jobs.testing.shelf import reconstructed
from sms_jobs.virtual_rig.campaigns import hole_and_step_translation


@pytest.fixture(scope="module")
def plate():
    return reconstructed(*hole_and_step_translation("hole", "small"), lambda text: None, 2)


def test_regions_are_right_nearer_to_the_edge(plate) -> None:
    found = profiles(*plate, WAYS)
    step, hole = found["step"], found["hole"]
    # Results begin where the shape does, two pixels from the step and one from the hole; without regions the
    # step's 0.1 px of difference is felt nearly as far as the subset of radius 8 px reaches.
    assert step["regions"].width() <= 3.0
    assert step["plain"].width() >= 6.0
    assert hole["regions"].width() <= 1.0
    assert hole["plain"].width() >= 3.0
    # Beyond the subset and the blending of its neighbours both ways see the same.
    np.testing.assert_allclose(
        step["plain"].image_rms[22:], step["regions"].image_rms[22:], rtol=0.05, equal_nan=True
    )


def test_distances_are_those_from_the_nearest_edge(plate) -> None:
    shelf, subject = plate
    truth = shelf.truth(subject)
    distance = distance_from_edges(truth)
    x, y = truth.shape.material[:2]
    measured = np.isfinite(distance["hole"])
    # The hole's edge lies 70 mm from its middle, and a pixel sees 1.6 mm there (2700 mm over 3.3 x 512 px).
    radius = np.hypot(x + 140.0, y - 60.0)[measured]
    np.testing.assert_allclose(distance["hole"][measured], (radius - 70.0) / 1.6, atol=1.5, rtol=0.06)
    assert not (measured & np.isfinite(distance["step"])).any()


def test_what_stays_moves_nowhere_in_the_image(plate) -> None:
    shelf, subject = plate
    truth = shelf.truth(subject)
    still = exact_image_displacement(shelf, subject, replace(truth, displacement=0.0 * truth.displacement))
    # Rounding, through the inverse of the distortion.
    assert np.abs(still[:, truth.shape.seen]).max() < 1e-6


def test_the_width_is_where_most_are_found_and_right() -> None:
    found = np.array([0.1, 0.4, 0.9, 1.0, 1.0])
    error = np.array([np.nan, 0.001, 0.001, 0.02, 0.001])
    assert Profile(found, error, error).width() == 4.0
    assert Profile(found, np.full(5, 0.001), error).width() == 2.0
    assert Profile(np.ones(5), np.full(5, 0.001), error).width() == 0.0
