"""Textures matched between two cameras."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import ndimage
from support.two_cameras import PITCH_MM, VOLUME, Floats, Height, cameras, curved, flat, seen_by

from sms_jobs.metrology.deformation.matching.camera_matching import (
    RaySearch,
    TexturedCamera,
    distance_from_rays,
    match_cameras,
)
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    MatchSettings,
    Noise,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.epipolar_search import Width, search_along_rays
from sms_jobs.metrology.deformation.matching.grid import GridMatches, GridSettings
from sms_jobs.metrology.deformation.matching.sampling import sample_nodes
from sms_jobs.metrology.geometry.camera import project

RADIUS, SPACING = 12, 6
NOISE = 20.0
"""Grey levels of 4095; the texture's contrast is 550 rms."""


@cache
def images(height: Height) -> tuple[tuple, tuple[Floats, Floats], Floats]:
    """Return two cameras, what they see, and where the second sees each pixel's point, (rows, columns, 2)."""
    rig = cameras()
    first, second = (seen_by(camera, height) for camera in rig)
    exact = project(rig[1].intrinsics, rig[1].pose, np.moveaxis(first.points, 0, -1))
    return rig, (first.levels, second.levels), exact


def textured(rig: tuple, levels: tuple[Floats, Floats], noise: float, seed: int = 0) -> list[TexturedCamera]:
    random = np.random.default_rng(seed)
    model = Noise(max(noise, 1.0) ** 2, 0.0)
    return [
        TexturedCamera(camera, image + random.normal(0.0, noise, image.shape) if noise else image, model)
        for camera, image in zip(rig, levels, strict=True)
    ]


def within(width_px: float) -> Width:
    return lambda points: np.full(len(points), width_px)


def matched(seen: list[TexturedCamera], order: int = 2) -> GridMatches:
    labels = np.ones(seen[0].texture.shape, dtype=np.int32)
    nodes = sample_nodes(labels, SPACING)
    settings = MatchSettings(RADIUS, 0.3, shape_order=order)
    images = prepare_images(*(one.texture for one in seen), labels, (seen[0].noise, seen[1].noise))
    return match_cameras(
        *seen, images, nodes, settings, GridSettings(SPACING), RaySearch(VOLUME, within(2.0))
    )[0]


def errors(found: GridMatches, exact: Floats) -> tuple[Floats, Floats]:
    """Return errors (n, 2) in px and standard deviations of the points that were matched."""
    good = found.matches.ending == CONVERGED
    x, y = found.x[good], found.y[good]
    place = np.stack([x, y], axis=1) + found.matches.warp[good][:, [0, 3]]
    return place - exact[y, x], found.matches.sigma[good]


def well_inside(found: GridMatches, exact: Floats) -> Floats:
    """Return which nodes have a whole subset in both images."""
    rows, columns = exact.shape[:2]
    x, y = found.x, found.y
    at = exact[y, x]
    room = np.minimum.reduce([x, columns - 1 - x, y, rows - 1 - y, at[:, 0], columns - 1 - at[:, 0]])
    return np.minimum(room, np.minimum(at[:, 1], rows - 1 - at[:, 1])) >= RADIUS + 5


def test_a_curved_surface_is_matched_to_thousandths_of_a_pixel() -> None:
    rig, levels, exact = images(curved)
    found = matched(textured(rig, levels, 0.0))
    inside = well_inside(found, exact)
    good = found.matches.ending == CONVERGED
    assert good[inside].mean() > 0.999
    off, _ = errors(found, exact)
    # What a quadratic subset of 25 px leaves of waves of 94 mm, which are 380 px: its fourth derivative.
    assert np.sqrt(np.mean(off[inside[good]] ** 2)) < 0.004


def test_a_first_order_subset_takes_curvature_for_a_shift() -> None:
    """By a sixth of the disparity's curvature times the squared radius: see `blend_matches`."""
    rig, levels, exact = images(curved)
    found = matched(textured(rig, levels, 0.0), order=1)
    off, _ = errors(found, exact)
    bend = sum(np.gradient(np.gradient(exact, axis=axis), axis=axis) for axis in (0, 1))
    good = (found.matches.ending == CONVERGED) & well_inside(found, exact)
    off = off[good[found.matches.ending == CONVERGED]]
    expected = bend[found.y[good], found.x[good]] * RADIUS**2 / 6.0
    rms, left = (np.sqrt(np.mean(one**2)) for one in (off, off - expected))
    assert rms > 0.008
    # The texture weighs the pixels of a subset differently from one to the next.
    assert left < 0.5 * rms


@pytest.mark.parametrize("height", [flat, curved])
def test_matches_scatter_as_they_say(height: Height) -> None:
    rig, levels, exact = images(height)
    scores = []
    for seed in range(3):
        found = matched(textured(rig, levels, NOISE, seed))
        off, sigma = errors(found, exact)
        inside = well_inside(found, exact)[found.matches.ending == CONVERGED]
        scores.append(np.mean((off / sigma)[inside] ** 2))
        assert (np.abs(off[inside]) < 6.0 * sigma[inside] + 0.05).all()
    # About 100 subsets fit side by side into what both see: 3 x 2 x 100 independent scores scatter by 6 %.
    assert np.sqrt(np.mean(scores)) == pytest.approx(1.0, abs=0.12)


def test_a_place_is_found_without_a_range() -> None:
    rig, levels, exact = images(curved)
    pixels = np.array([[150.0, 100.0], [220.0, 180.0], [260.0, 60.0]])
    found = search_along_rays(*rig, levels, pixels, VOLUME, radius=20, width=within(2.0))
    truth = exact[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] - pixels
    np.testing.assert_allclose(found.warp[:, [0, 3]], truth, atol=2.0)
    assert found.unique.all()


def test_a_place_is_looked_for_as_far_beside_its_ray_as_that_is_known_there() -> None:
    """The partner's image is 12 px too low, and only above are lines known to be that uncertain."""
    rig, levels, exact = images(curved)
    lower = (levels[0], np.roll(levels[1], 12, axis=0))
    pixels = np.array([[200.0, 70.0], [200.0, 220.0]])
    found = search_along_rays(
        *rig, lower, pixels, VOLUME, radius=20, width=lambda points: np.where(points[:, 1] > 0.0, 14.0, 3.0)
    )
    there = exact[pixels[:, 1].astype(int), pixels[:, 0].astype(int)] + [0.0, 12.0] - pixels
    # To a step of 2 px along and across.
    np.testing.assert_allclose(found.warp[0, [0, 3]], there[0], atol=2.0)
    assert found.score[0] > 0.8
    assert not found.score[1] > 0.6


def test_a_grid_is_no_texture_to_begin_at() -> None:
    """Lines of equal distance look alike every period: none of the places along a ray is the place."""
    rig = cameras()
    period = 8 * PITCH_MM
    levels = []
    for camera in rig:
        x, y = seen_by(camera, flat).material
        levels.append(2000.0 + 500.0 * np.cos(2.0 * np.pi * x / period) * np.cos(2.0 * np.pi * y / period))
    found = matched(textured(rig, (levels[0], levels[1]), 0.0))
    assert not (found.matches.ending == CONVERGED).any()


def test_what_one_camera_alone_sees_has_no_match() -> None:
    """A plate before the partner's lens hides what it sees there: no value, and none beside it is wrong."""
    rig, levels, exact = images(curved)
    hidden = levels[1].copy()
    hidden[:, 180:230] = 2000.0
    found = matched(textured(rig, (levels[0], hidden), NOISE))
    off, sigma = errors(found, exact)
    good = found.matches.ending == CONVERGED
    at = exact[found.y, found.x][:, 0]
    covered = (at > 186) & (at < 224)
    assert not good[covered].any()
    clear = good & ((at < 180 - RADIUS - 3) | (at > 230 + RADIUS + 3))
    assert clear.sum() > 500
    assert (np.abs(off) < 6.0 * sigma + 0.05).all()


def test_cameras_that_were_exchanged_are_told_from_images_with_nothing_in_common() -> None:
    rig, levels, _ = images(curved)
    seen = textured(rig, levels, NOISE)
    swapped = [replace(one, camera=other.camera) for one, other in zip(seen, seen[::-1], strict=True)]
    labels = np.ones(levels[0].shape, dtype=np.int32)
    nodes = sample_nodes(labels, SPACING)
    assert distance_from_rays(*swapped, labels, nodes, VOLUME) > 1.0
    # What was found is a whole pixel, up to half of one off.
    assert distance_from_rays(*seen, labels, nodes, VOLUME) < 0.5
    strange = replace(seen[1], texture=np.random.default_rng(5).normal(2000.0, 500.0, levels[1].shape))
    assert np.isnan(distance_from_rays(seen[0], strange, labels, nodes, VOLUME))


@pytest.mark.parametrize(("blurred", "spread_px"), [(1, 0.8), (0, 0.8), (0, 1.0)])
def test_a_camera_that_is_out_of_focus(blurred: int, spread_px: float) -> None:
    """A partner is compared as blurred as it is; what cannot be made sharp is matched as it was."""
    rig, levels, exact = images(curved)
    shown = list(levels)
    shown[blurred] = ndimage.gaussian_filter(levels[blurred], spread_px)
    found = matched(textured(rig, (shown[0], shown[1]), NOISE))
    inside = well_inside(found, exact)
    good = found.matches.ending == CONVERGED
    off, sigma = (values[inside[good]] for values in errors(found, exact))
    # 0.8 px of blur beside a speckle of 2.4 px: without telling, places were off by 0.021 and 0.024 px.
    if spread_px < 1.0:
        assert good[inside].mean() > 0.99
        assert np.sqrt(np.mean(off**2)) < 0.015
    else:
        assert good[inside].mean() > 0.15
    # Some 150 subsets do not overlap, of which scatter tells the deviation: 10 %, twice.
    assert np.sqrt(np.mean((off / sigma) ** 2, axis=0)).max() < 1.2
