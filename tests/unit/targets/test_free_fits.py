"""Spheres and planes through all points: right on exact points, and honest about noise."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.targets.free_fits import fit_free_plane, fit_free_sphere

CENTRE = np.array([10.0, -20.0, 900.0])
RADIUS = 25.0


def cap(rng: np.random.Generator, count: int = 2000, angle: float = 1.0) -> np.ndarray:
    """Return directions (n, 3) within an angle of -Z, evenly over the cap."""
    cosine = rng.uniform(np.cos(angle), 1.0, count)
    turn = rng.uniform(0.0, 2.0 * np.pi, count)
    sine = np.sqrt(1.0 - cosine**2)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), -cosine], axis=1)


def along_z(count: int, sigma: float) -> np.ndarray:
    tensor = np.zeros((count, 3, 3))
    tensor[:, 2, 2] = sigma**2
    return tensor


def test_exact_points_have_their_sphere(rng: np.random.Generator) -> None:
    points = CENTRE + RADIUS * cap(rng)
    found = fit_free_sphere(points, along_z(2000, 0.01), CENTRE + 3.0, 20.0)
    assert found.centre == pytest.approx(CENTRE, abs=1e-8)
    assert found.radius == pytest.approx(RADIUS, abs=1e-8)
    assert found.form.span < 1e-8
    assert found.form.points == 2000


def test_the_radius_scatters_as_stated(rng: np.random.Generator) -> None:
    directions, sigma = cap(rng, 400), 0.02
    scores = []
    for _ in range(300):
        points = CENTRE + RADIUS * directions
        points[:, 2] += rng.normal(0.0, sigma, len(points))
        found = fit_free_sphere(points, along_z(400, sigma), CENTRE, RADIUS)
        scores.append((found.radius - RADIUS) / found.radius_sigma)
    # 300 trials tell a standard deviation to 4 %.
    assert 0.88 < np.std(scores) < 1.12
    assert abs(np.mean(scores)) < 0.25


def test_the_span_is_that_of_the_form(rng: np.random.Generator) -> None:
    # A bump of 50 um on one point of an otherwise exact sphere.
    directions = cap(rng)
    points = CENTRE + RADIUS * directions
    points[7] += 0.05 * directions[7]
    found = fit_free_sphere(points, along_z(2000, 0.003), CENTRE, RADIUS)
    assert found.form.span == pytest.approx(0.05, abs=1e-3)
    # The two extreme points have 3 um along Z each, seen along their normals.
    assert 0.0 < found.form.span_sigma < np.hypot(0.003, 0.003) + 1e-12


def test_points_that_share_errors_count_less(rng: np.random.Generator) -> None:
    points = CENTRE + RADIUS * cap(rng)
    alone, shared = (
        fit_free_sphere(points, along_z(2000, 0.01), CENTRE, RADIUS, alike).radius_sigma
        for alike in (1.0, 25.0)
    )
    assert shared == pytest.approx(5.0 * alone)


def test_a_plane_has_its_span_without_what_does_not_belong_to_it(rng: np.random.Generator) -> None:
    place = rng.uniform(-100.0, 100.0, (3000, 2))
    height = 0.01 * np.sign(place[:, 0])
    points = np.column_stack([place, 0.2 * place[:, 0] - 0.1 * place[:, 1] + 700.0 + height])
    points[:5, 2] += 3.0
    form, used = fit_free_plane(points, along_z(3000, 0.0))
    assert not used[:5].any()
    assert used[5:].all()
    # Steps of +-10 um: a plane tilts towards them, by half of their slope at most.
    assert 0.02 * 0.9 < form.span * np.sqrt(1.05) < 0.04
    assert form.span_sigma == 0.0


def test_too_little_is_refused() -> None:
    with pytest.raises(InvalidInput, match="3 points hold no plane"):
        fit_free_plane(np.eye(3), np.zeros((3, 3, 3)))
    line = np.outer(np.arange(9.0), [1.0, 2.0, 3.0])
    with pytest.raises(InvalidInput, match="9 points hold no plane"):
        fit_free_plane(line, np.zeros((9, 3, 3)))
    with pytest.raises(InvalidInput, match="hold no sphere"):
        fit_free_sphere(np.repeat([[0.0, 0.0, 1.0]], 9, axis=0), np.zeros((9, 3, 3)), np.zeros(3), 1.0)
