"""Places in a partner's image: each with a deviation that holds, whatever the surface does."""

from __future__ import annotations

import numpy as np
import pytest
from support.two_cameras import VOLUME, Floats, Height, cameras, seen_by

from sms_jobs.kinds.shape import stereo
from sms_jobs.kinds.shape.partner_places import _in_partner, places_of_pixels
from sms_jobs.metrology.deformation.matching.camera_matching import RaySearch, TexturedCamera, match_cameras
from sms_jobs.metrology.deformation.matching.correlation import MatchSettings, Noise, prepare_images
from sms_jobs.metrology.deformation.matching.grid import GridSettings
from sms_jobs.metrology.deformation.matching.sampling import sample_nodes
from sms_jobs.metrology.geometry.camera import project

RADIUS, SPACING, RIM = 12, 5, 20
NOISE = 20.0
"""Grey levels of 4095."""


def errors(height: Height, seed: int) -> tuple[Floats, Floats, Floats]:
    """Return by how many px places are off, their variances, and how many px wide the partner sees one.

    Each (2, rows, columns), the last (rows, columns); without a rim.
    """
    rig = cameras()
    first, second = (seen_by(camera, height) for camera in rig)
    random = np.random.default_rng(seed)
    own, other = (
        TexturedCamera(camera, one.levels + random.normal(0.0, NOISE, one.levels.shape), Noise(NOISE**2, 0.0))
        for camera, one in zip(rig, (first, second), strict=True)
    )
    labels = np.ones(own.texture.shape, np.int32)
    parameters = stereo.KIND.parameters(smoothing_px=0.0, subset_radius_px=RADIUS, spacing_px=SPACING)
    found, images = match_cameras(
        own,
        other,
        prepare_images(own.texture, other.texture, labels, (own.noise, other.noise)),
        sample_nodes(labels, SPACING),
        MatchSettings(RADIUS, 0.3, shape_order=2),
        GridSettings(SPACING),
        RaySearch(VOLUME, lambda points: np.full(len(points), 2.0)),
    )
    places = places_of_pixels((rig[0], rig[1]), images, found, parameters, 1)
    exact = np.moveaxis(project(rig[1].intrinsics, rig[1].pose, np.moveaxis(first.points, 0, -1)), -1, 0)
    inner = np.s_[:, RIM:-RIM, RIM:-RIM]
    return (places.place - exact)[inner], places.variance[inner], np.gradient(exact[0], axis=1)[inner[1:]]


@pytest.mark.parametrize("wave_mm", [40.0, 8.0])
def test_waves_that_subsets_cannot_follow_are_in_the_deviation(wave_mm: float) -> None:
    """Subsets of 25 px follow waves of 160 px, and those of 32 px not: by 0.02 px rms along the rows."""
    error, variance, _ = errors(lambda x, y: 0.2 * np.sin(2.0 * np.pi * x / wave_mm), 1)
    assert np.isfinite(error).mean() > 0.95
    off = error / np.sqrt(variance)
    over = np.sqrt(np.nanmean(off**2, axis=(1, 2)))
    # 200 subsets do not overlap: noise alone scatters by 5 % at the most of what is stated, three times.
    assert over.max() < 1.15
    assert np.nanmax(np.abs(off)) < 6.0
    if wave_mm > 20.0:
        assert over.min() > 0.85


def test_what_a_partner_sees_obliquely_is_stated_as_it_is() -> None:
    """A cylinder of 60 mm: what texture sampled coarsely does to windows is no bias, and a px there is less.

    Without either the columns were stated 1.4 times too large.
    """
    squares = []
    for seed in range(3):
        error, variance, wide = errors(lambda x, y: np.sqrt(np.maximum(60.0**2 - x**2, 1.0)) - 60.0, seed)
        there = (wide > 0.75) & (wide < 0.95) & np.isfinite(error).all(axis=0)
        squares.append((error[:, there] ** 2).mean(axis=1) / variance[:, there].mean(axis=1))
    over = np.sqrt(np.mean(squares, axis=0))
    # 40 subsets of each seed do not overlap: 6.5 % of an rms, three times.
    assert over.min() > 0.8
    assert over.max() < 1.2


def test_variances_are_carried_by_the_slopes_of_places() -> None:
    y, x = np.mgrid[0:30, 0:40].astype(float)
    place = np.stack([1.1 * x + 0.2 * y, -0.3 * x + 0.9 * y])
    variance, none = np.zeros((2, 30, 40)), np.zeros((2, 30, 40))
    variance[:, 8:20, 10:30] = np.array([4.0, 1.0])[:, None, None]
    variance[1, 25, 35] = 2.0
    carried, nothing = _in_partner((variance, none), place, 3)
    squares = np.array([[1.1**2, 0.2**2], [0.3**2, 0.9**2]])
    # Rounding: two products of numbers below 4, of slopes of places below 50 over 6 px.
    np.testing.assert_allclose(carried, np.tensordot(squares, variance, axes=1), atol=1e-12)
    assert not nothing.any()


def test_variances_of_places_without_slopes_are_as_large_in_both_images() -> None:
    place = np.full((2, 9, 9), np.nan)
    place[:, 4, 4] = 5.0
    variance = np.zeros((2, 9, 9))
    variance[:, 4, 4] = 2.0, 3.0
    (carried,) = _in_partner((variance,), place, 2)
    np.testing.assert_array_equal(carried, variance)
