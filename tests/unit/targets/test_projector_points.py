"""Points of a target, carried to the projector through the phase: right, and as uncertain as they say."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.targets.projector_points import carry_to_projector

Floats = NDArray[np.float64]
# From the camera to the projector by way of a tilted plane, with two fifths of a projector px a camera px.
HOMOGRAPHY = np.array([[0.42, 0.03, 100.0], [-0.02, 0.38, 80.0], [1.5e-4, -1e-4, 1.0]])
ROWS, COLUMNS = 400, 500
SIGMA = 0.05
RADIUS = 9.0


def mapped(points: Floats) -> Floats:
    p = points @ HOMOGRAPHY[:, :2].T + HOMOGRAPHY[:, 2]
    return np.asarray(p[..., :2] / p[..., 2:])


def centres(rng: np.random.Generator) -> Floats:
    y, x = np.mgrid[30:380:35, 30:480:35]
    return np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-0.5, 0.5, (x.size, 2))


def maps(rng: np.random.Generator, at: Floats, ink_sigma: float) -> tuple[Floats, Floats]:
    """Return noisy maps whose noise is larger in the dots' ink; NaN there for an infinite one."""
    y, x = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float64)
    truth = np.moveaxis(mapped(np.stack([x, y], axis=-1)), -1, 0)
    sigma = np.full((ROWS, COLUMNS), SIGMA)
    for cx, cy in at:
        sigma[np.hypot(x - cx, y - cy) < RADIUS] = ink_sigma
    pixel = truth + rng.normal(0.0, 1.0, truth.shape) * np.where(np.isfinite(sigma), sigma, 0.0)
    pixel[:, ~np.isfinite(sigma)] = np.nan
    return pixel, sigma


@pytest.mark.parametrize("ink_sigma", [SIGMA, 5 * SIGMA, np.inf])
def test_scatter_is_as_predicted(rng: np.random.Generator, ink_sigma: float) -> None:
    at = centres(rng)
    pixel, sigma = maps(rng, at, ink_sigma)
    found_at = at + rng.normal(0.0, 0.01, at.shape)
    radius = np.full(len(at), RADIUS)
    found = carry_to_projector(pixel, sigma, found_at, np.full(len(at), 0.01), radius)
    assert found.refused == {}
    error = found.pixel - mapped(at)
    z = error / found.sigma[:, None]
    # 286 normal numbers: 1 / sqrt(572) = 4 %, four of those; noise that the eye of the robust fit leaves out
    # costs 5 % of efficiency, some of which the sandwich does not see.
    assert float(np.sqrt(np.mean(z**2))) == pytest.approx(1.0, abs=0.2)
    # What one pixel says is 0.05 px; what hundreds say is several times better.
    assert float(found.sigma.max()) < 0.4 * SIGMA


def test_bad_pixels_do_not_matter(rng: np.random.Generator) -> None:
    at = centres(rng)
    pixel, sigma = maps(rng, at, SIGMA)
    clean = carry_to_projector(pixel, sigma, at, np.zeros(len(at)), np.full(len(at), RADIUS))
    wrong = rng.random((ROWS, COLUMNS)) < 0.1
    pixel[:, wrong] += rng.uniform(5.0, 40.0, (2, int(wrong.sum())))  # a fringe or more off
    found = carry_to_projector(pixel, sigma, at, np.zeros(len(at)), np.full(len(at), RADIUS))
    # A tenth of the pixels is lost, and with them 5 % of the accuracy; what is left out differs a little.
    assert np.abs(found.pixel - clean.pixel).max() < 6 * float(clean.sigma.max())
    assert np.abs(found.sigma / clean.sigma - 1.0).max() < 0.4


def test_more_noise_than_said_is_noticed(rng: np.random.Generator) -> None:
    at = centres(rng)
    pixel, sigma = maps(rng, at, SIGMA)
    radius = np.full(len(at), RADIUS)
    right = carry_to_projector(pixel, sigma, at, np.zeros(len(at)), radius)
    boasting = carry_to_projector(pixel, sigma / 4.0, at, np.zeros(len(at)), radius)
    # The median size of 2000 residuals is known to 1.2 / sqrt(2000) = 3 %.
    np.testing.assert_allclose(boasting.sigma, right.sigma, rtol=0.1)


def test_a_corner_has_no_radius(rng: np.random.Generator) -> None:
    at = centres(rng)
    pixel, sigma = maps(rng, np.empty((0, 2)), SIGMA)
    found = carry_to_projector(pixel, sigma, at, np.zeros(len(at)), np.zeros(len(at)))
    # 200 pixels and a polynomial of second order: the middle is known to sqrt(4 / 200) of a pixel's noise.
    assert np.abs(found.pixel - mapped(at)).max() < 5 * SIGMA * np.sqrt(4 / 200)


def test_what_cannot_be_carried_is_refused(rng: np.random.Generator) -> None:
    pixel, sigma = maps(rng, np.empty((0, 2)), SIGMA)
    pixel[:, :, :100] = np.nan
    pixel[:, 300:, 300:] = np.nan
    at = np.array([[100.0, 100.0], [400.0, 350.0], [900.0, 10.0], [200.0, 200.0]])
    found = carry_to_projector(pixel, sigma, at, np.zeros(4), np.full(4, RADIUS))
    assert found.refused == {
        "phase on one side only": 1,
        "too few pixels with a phase": 1,
        "outside the image": 1,
    }
    assert np.isnan(found.pixel[:3]).all()
    assert np.isnan(found.sigma[:3]).all()
    assert np.isfinite(found.pixel[3]).all()
