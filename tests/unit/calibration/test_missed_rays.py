"""A plane through what points lie off the images of their rays: what tells that a camera has moved."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.missed_rays import MissedRays, missed_rays

NOISE = 0.02


def pixels(left: int = 0, step: int = 10) -> Floats:
    """Return the places of nodes that cover 300 x 200 px, (2, n)."""
    x, y = np.meshgrid(np.arange(left, left + 300, step), np.arange(0, 200, step))
    return np.stack([x.ravel(), y.ravel()]).astype(np.float64)


def fitted(off: Floats, at: Floats, each: float = 1.0) -> MissedRays:
    found = missed_rays(at, off, each)
    assert found is not None
    return found


def test_a_plane_is_found_beside_noise_and_what_is_far_off() -> None:
    random, at = np.random.default_rng(1), pixels()
    off = 0.3 + 4e-4 * at[0] - 2e-4 * at[1] + NOISE * random.standard_normal(at.shape[1])
    off[::20] += 5.0
    off[3::50] = np.nan
    found = fitted(off, at)
    x, y = found.middle
    wanted = (0.3 + 4e-4 * x - 2e-4 * y, 4e-4 * found.size[0], -2e-4 * found.size[1])
    # Each of the three has the noise of a mean over some 550 nodes, 0.0009 px.
    np.testing.assert_allclose(found.plane, wanted, atol=4.0 * NOISE / np.sqrt(550.0))
    assert found.scatter == pytest.approx(NOISE, rel=0.15)  # by a median of as many: 5 %


@pytest.mark.parametrize("each", [1, 9])
def test_planes_by_noise_scatter_as_they_say(each: int) -> None:
    """Nodes in squares of three have one error where nine share it."""
    random, at = np.random.default_rng(2), pixels()
    shape = (20, 30)
    rms, stated = [], []
    for _ in range(300):
        side = int(np.sqrt(each))
        own = random.standard_normal(-(-np.array(shape) // side))
        shared = np.kron(own, np.ones((side, side)))[: shape[0], : shape[1]]
        found = fitted(NOISE * shared.ravel(), at, each)
        rms.append(np.linalg.norm(found.plane))
        stated.append(found.sigma)
    # Of 300 planes of three parameters the rms is known to 0.5 / sqrt(450), 2.4 %.
    assert np.sqrt(np.mean(np.square(rms))) == pytest.approx(float(np.mean(stated)), rel=0.1)


def test_a_change_is_that_of_the_plane_wherever_points_are() -> None:
    """A turn about the camera's axis and a shift; the specimen has moved in the image meanwhile."""
    random = np.random.default_rng(3)
    before, now = pixels(), pixels(left=150)
    first = fitted(1.0 + NOISE * random.standard_normal(before.shape[1]), before)
    second = fitted(1.1 + 1e-3 * now[0] + NOISE * random.standard_normal(now.shape[1]), now)
    wanted = np.sqrt(np.mean((0.1 + 1e-3 * before[0]) ** 2))
    # Half of the first plane lies beyond the nodes of the second, whose slope is known to 0.00001.
    assert second.change_px(first) == pytest.approx(float(wanted), rel=0.03)
    assert first.change_px(first) == 0.0


def test_noise_alone_is_hardly_ever_a_change() -> None:
    random, at = np.random.default_rng(4), pixels()
    planes = [fitted(0.5 + NOISE * random.standard_normal(at.shape[1]), at) for _ in range(400)]
    changes = np.array([b.change_px(a) for a, b in zip(planes[::2], planes[1::2], strict=True)])
    # The square of the change over the sum of variances is chi-square of 3, over 3: above 4 once in 140.
    assert np.count_nonzero(changes) <= 7


@pytest.mark.parametrize("known", [0, 10, 30])
def test_few_points_tell_nothing(known: int) -> None:
    at = pixels()
    off = np.full(at.shape[1], np.nan)
    off[:known] = 0.1
    assert missed_rays(at, off, 2.0) is None
