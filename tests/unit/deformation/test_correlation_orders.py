"""Each shape order finds the field that it can follow, and its standard deviations are its scatter."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.metrology.deformation.matching import correlation
from sms_jobs.metrology.deformation.matching.correlation import (
    Matches,
    MatchSettings,
    Noise,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import GridSettings, match_grid
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings
from sms_jobs.metrology.deformation.matching.shape_functions import carried
from sms_jobs.metrology.images.spline import Interpolant

Order = Literal[0, 1, 2]
SIZE = 160
CENTRE = SIZE / 2
FIELDS = {  # about the middle: what each order can follow
    0: np.array([0.37, 0, 0, -0.21, *(0.0,) * 8]),
    1: np.array([0.37, 0.004, -0.003, -0.21, 0.002, 0.005, *(0.0,) * 6]),
    2: np.array([0.37, 0.004, -0.003, -0.21, 0.002, 0.005, 4e-4, -2e-4, 3e-4, -3e-4, 2e-4, 5e-4]),
}
orders = pytest.mark.parametrize("order", [0, 1, 2])


def displacement(p: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the field's warps, (n, 12), about points of the image."""
    return carried(np.tile(p, (x.size, 1)), x.ravel() - CENTRE, y.ravel() - CENTRE)


def bent_pair(speckle, order: Order) -> tuple[np.ndarray, np.ndarray]:
    pattern = speckle.random(31, SIZE)

    def source(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = x.copy(), y.copy()
        for _ in range(30):  # contracts by the slope, below 0.06
            p = displacement(FIELDS[order], a, b)
            a, b = x - p[:, 0].reshape(x.shape), y - p[:, 3].reshape(x.shape)
        return a, b

    return pattern.image(SIZE), pattern.image(SIZE, source)


@pytest.fixture(scope="module", params=[0, 1, 2])
def case(speckle, request: pytest.FixtureRequest) -> tuple[Order, np.ndarray, np.ndarray]:
    return request.param, *bent_pair(speckle, request.param)


@pytest.fixture(scope="module")
def bent(speckle) -> tuple[np.ndarray, np.ndarray]:
    return bent_pair(speckle, 2)


def points(step: int, rim: int = 24) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(rim, SIZE - rim, step), np.arange(rim, SIZE - rim, step))
    return x.ravel().astype(np.int64), y.ravel().astype(np.int64)


def matched(images, order: Order, x: np.ndarray, y: np.ndarray, truth: np.ndarray, **options) -> Matches:
    guess = np.zeros((len(x), 6))
    guess[:, [0, 3]] = np.rint(2.0 * truth[:, [0, 3]]) / 2.0
    return match_points(images, x, y, guess, MatchSettings(shape_order=order, **options))


def whole(shape: tuple[int, int]) -> np.ndarray:
    return np.ones(shape, np.int32)


def test_each_order_recovers_its_field(case) -> None:
    order, reference, deformed = case
    x, y = points(14)
    truth = displacement(FIELDS[order], x, y)
    found = matched(
        prepare_images(reference, deformed, whole(reference.shape)), order, x, y, truth, radius=12
    )
    assert (found.ending == correlation.CONVERGED).all()
    assert found.warp.shape == (len(x), 12 if order == 2 else 6)
    # What a quintic spline makes of blobs 1.8 px wide is off by less than 10^-3 px; over the radius of 12 px
    # that is 10^-4 a px and 2 / 12^2 of 10^-3 in the curvature.
    assert np.abs(found.warp - truth[:, : found.warp.shape[1]])[:, [0, 3]].max() < 1e-3
    assert np.abs(found.warp - truth[:, : found.warp.shape[1]])[:, [1, 2, 4, 5]].max() < 2e-4
    assert np.abs(found.warp[:, 6:] - truth[:, 6 : found.warp.shape[1]]).max(initial=0.0) < 3e-5


def test_the_second_order_follows_what_the_first_averages(bent) -> None:
    images = prepare_images(*bent, whole((SIZE, SIZE)))
    x, y = points(14)
    truth = displacement(FIELDS[2], x, y)
    error = {}
    for order in (0, 1, 2):
        warp = matched(images, order, x, y, truth, radius=12).warp
        error[order] = np.sqrt(np.mean((warp[:, [0, 3]] - truth[:, [0, 3]]) ** 2))
    # The mean over a square of x^2 / 2 is radius^2 / 6: 24 px^2 times curvatures of 3 x 10^-4, 0.007 px each
    # way, which the first order finds instead of the middle.
    assert 0.004 < error[1] < 0.03
    assert error[2] < 0.001


@orders
def test_the_kernel_is_the_slow_reference(bent, rng: np.random.Generator, order: Order) -> None:
    """Where it ends, a regression of g on f, a constant and the slopes finds nothing left to move."""
    reference, deformed = (image + rng.normal(0.0, 20.0, image.shape) for image in bent)
    labels = whole((SIZE, SIZE))
    labels[:, 84:] = 2
    images = prepare_images(reference, deformed, labels)
    coefficients = ndimage.spline_filter(deformed, order=5, mode="mirror")
    x, y = np.array([40, 80, 110]), np.array([50, 87, 62])
    truth = displacement(FIELDS[2], x, y)
    found = matched(images, order, x, y, truth, radius=10, tolerance=1e-10, iterations=80)
    for k, p in enumerate(found.warp):
        j, i = (offset.ravel() for offset in np.mgrid[-10:11, -10:11])
        own = labels[y[k] + j, x[k] + i] == labels[y[k], x[k]]
        i, j = i[own], j[own]
        full = np.zeros((len(i), 12))
        full[:, : len(p)] = p
        there = carried(full, i, j)
        g = ndimage.map_coordinates(
            coefficients, [y[k] + j + there[:, 3], x[k] + i + there[:, 0]], order=5, prefilter=False
        )
        f, gx, gy = (a[y[k] + j, x[k] + i] for a in (reference, images.gradient_x, images.gradient_y))
        terms = ([1.0], [1.0, i, j], [1.0, i, j, i * i / 2, i * j, j * j / 2])[order]
        design = np.stack([w * t for w in (gx, gy) for t in terms] + [f, np.ones_like(f)], axis=1)
        solved, *_ = np.linalg.lstsq(design, g, rcond=None)
        step = solved[:-2] / solved[-2]
        second = len(terms)
        # The tolerance of the iteration, a hundred times that for the rounding of normal equations whose
        # terms grow to 10^2.
        assert np.abs(step[[0, second]]).max() < 1e-8
        assert found.score[k] == pytest.approx(np.corrcoef(f, g)[0, 1], abs=1e-9)
        scale = np.linalg.norm(f - f.mean()) / np.linalg.norm(g - g.mean())
        residual = (f - f.mean()) - scale * (g - g.mean())
        covariance = np.linalg.inv(design.T @ design) * (residual @ residual) / (len(f) - design.shape[1])
        # 1 - score cancels all but six of its sixteen digits.
        np.testing.assert_allclose(found.sigma[k], np.sqrt(np.diag(covariance))[[0, second]], rtol=1e-5)


@pytest.mark.parametrize("model", [True, False])
def test_scatter_is_as_predicted(case, rng: np.random.Generator, model: bool) -> None:
    order, *pair = case
    read_noise, gain = 12.0, 0.05
    noise = Noise(read_noise**2, gain) if model else Noise(0.0, 0.0)
    x, y = points(21)
    truth = displacement(FIELDS[order], x, y)[:, [0, 3]]
    error, sigma = [], []
    for _ in range(10):
        noisy = [i + rng.normal(size=i.shape) * np.sqrt(read_noise**2 + gain * i) for i in pair]
        images = prepare_images(*noisy, whole((SIZE, SIZE)), (noise, noise))
        found = matched(images, order, x, y, np.pad(truth, ((0, 0), (0, 2)))[:, [0, 2, 2, 1]], radius=10)
        assert (found.ending == correlation.CONVERGED).all()
        error.append(found.warp[:, [0, 3]] - truth)
        sigma.append(found.sigma)
    ratio = np.sqrt(np.mean((np.array(error) / np.array(sigma)) ** 2))
    # 720 deviates tell a standard deviation to 1 / sqrt(2 x 720) = 2.6 %; the requirement is 20 %. Without a
    # noise model the residual is all there is, which the interpolation smooths.
    assert 0.9 < ratio < (1.1 if model else 1.2)
    assert np.abs(np.mean(error, axis=(0, 1))).max() < 3.0 * np.mean(sigma) / np.sqrt(len(x) * 10)


@pytest.mark.parametrize(
    ("width", "cubic", "local"), [(1.2, (0.002, 0.02), (0.002, 0.02)), (1.8, (0.0, 1e-3), (0.003, 0.01))]
)
def test_the_quintic_has_less_bias_than_the_cubics(
    speckle, width: float, cubic: tuple[float, float], local: tuple[float, float]
) -> None:
    pattern = speckle.random(8, 96, width=width)
    reference, deformed = pattern.image(96), pattern.image(96, lambda x, y: (x - 0.25, y - 0.25))
    x, y = (v.ravel().astype(np.int64) for v in np.mgrid[24:72:8, 24:72:8])
    truth = np.full((len(x), 6), 0.25)
    bias = {}
    splines: tuple[Interpolant, ...] = ("local-cubic", "cubic", "quintic")
    for spline in splines:
        images = prepare_images(reference, deformed, whole((96, 96)), interpolant=spline)
        found = matched(images, 1, x, y, truth, radius=10)
        assert (found.ending == correlation.CONVERGED).all()
        bias[spline] = np.abs(found.warp[:, [0, 3]] - 0.25).max()
    # Fine speckle: both cubics follow it to a fiftieth of a pixel, the quintic several times better. Coarser
    # speckle rids the splines through all pixels of their bias, and not the one through sixteen.
    assert cubic[0] <= bias["cubic"] < cubic[1]
    assert local[0] < bias["local-cubic"] < local[1]
    assert bias["quintic"] < 0.5 * min(bias["cubic"], bias["local-cubic"])


@orders
def test_threads_do_not_matter_on_a_grid(bent, order: Order) -> None:
    reference, deformed = bent
    images = prepare_images(reference, deformed, whole(reference.shape))
    settings = MatchSettings(radius=10, shape_order=order), GridSettings(12), SearchSettings(8, 8)
    one, two = (match_grid(images, deformed, *settings, threads=n).matches for n in (1, 2))
    for a, b in zip(vars(one).values(), vars(two).values(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert (one.ending == correlation.CONVERGED).mean() > 0.9
