"""Values along a line are taken together as far as they agree; its places tell where it goes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from sms_jobs.metrology.deformation.cracks.curves import course, estimated, walk, walk_of_slopes
from sms_jobs.metrology.deformation.cracks.lines import _least_jump, _Tip

AT = np.linspace(3.0, 393.0, 40).astype(np.float64)
SIGMA = 0.03


def found(true: np.ndarray, rng: np.random.Generator, width: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return errors and stated variances of noisy values."""
    values = true + rng.normal(0.0, SIGMA, len(AT))
    sought, variance = estimated(walk(AT, AT, width), values[:, None], SIGMA**2 * np.eye(len(AT)))
    return sought[:, 0] - true, variance


@pytest.mark.parametrize("slope", [0.0, 0.01])
def test_what_is_even_is_told_by_all_values(rng: np.random.Generator, slope: float) -> None:
    """A straight line through 40 values has 2 / 40 of their variance; roughness that may be adds to it."""
    errors, variances = (
        np.array(one) for one in zip(*(found(slope * AT, rng) for _ in range(40)), strict=True)
    )
    # 80 independent degrees: the rms is known to 8 %, and roughness is found by chance in some of the draws.
    assert 0.7 * np.sqrt(0.05) < np.sqrt(np.mean(errors**2)) / SIGMA < 1.6 * np.sqrt(0.05)
    assert 0.7 < np.sqrt(np.mean(errors**2 / variances)) < 1.2


@pytest.mark.parametrize("roughness", [0.01, 0.1, 1.0])
def test_the_variance_of_a_walk_holds(rng: np.random.Generator, roughness: float) -> None:
    """Steps that are as large as a third of the noise, as it, and three times as it."""
    scores = []
    for _ in range(40):
        steps = rng.normal(0.0, SIGMA * np.sqrt(roughness * 10.0), len(AT))
        error, variance = found(np.cumsum(steps), rng)
        scores.append(error / np.sqrt(variance))
    # 40 draws of some 3 to 40 independent values: known to 10 % or better.
    assert 0.8 < np.sqrt(np.mean(np.square(scores))) < 1.2


def test_a_step_is_no_end_to_what_is_told() -> None:
    """Without noise each value tells its own, however far they are apart."""
    true = np.where(AT < 200.0, 0.0, 5.0)
    sought, _ = estimated(walk(AT, AT, 0.0), true[:, None], 1e-12 * np.eye(len(AT)))
    assert np.abs(sought[:, 0] - true).max() < 1e-5


def test_values_and_slopes_are_those_of_one_walk() -> None:
    """The covariance of a slope with values is the derivative of that of a value with them."""
    where, step = np.array([57.0, 203.0, 391.0]), 1e-4
    ahead, behind = walk_of_slopes(AT, where + step), walk_of_slopes(AT, where - step)
    derivative = (ahead.towards[:3] - behind.towards[:3]) / (2.0 * step)
    np.testing.assert_allclose(walk_of_slopes(AT, where).towards[3:], derivative, rtol=1e-6)
    among = walk_of_slopes(AT, AT)
    np.testing.assert_allclose(among.towards[: len(AT)], among.among)
    np.testing.assert_allclose(np.diag(among.among), among.own[: len(AT)])


def test_the_direction_of_a_line_holds_its_error(rng: np.random.Generator) -> None:
    """Straight lines at 30 degrees whose places stray by 1 px, together over a subset of 21 px."""
    along = np.arange(400.0)
    ahead, across = np.array([0.5, np.sqrt(0.75)]), np.array([-np.sqrt(0.75), 0.5])
    tilts, errors = [], []
    for _ in range(30):
        stray = np.repeat(rng.normal(0.0, 1.0, 20), 21)[:400]
        place = along[:, None] * ahead + stray[:, None] * across
        goes = course(place, (np.arange(10) + 0.5) / 10, 10)
        tilts.append(goes.ahead @ across)
        errors.append(goes.error)
    score = np.array(tilts) / np.array(errors)
    # A line through 19 places of 1 px over 400 px is known to 0.002 rad. That it may bend unseen is
    # stated, too: where it does not, that is twice too much.
    assert 0.3 < np.sqrt(np.mean(score**2)) < 1.3
    assert np.sqrt(np.mean(np.square(tilts))) < 0.01


def test_a_line_that_bends_is_followed() -> None:
    """A quarter of a circle of 300 px: its direction at every part, and at its end."""
    angle = np.linspace(0.0, np.pi / 2, 472)
    place = 300.0 * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    part = np.array([0.0, 0.3, 0.5, 1.0])
    goes = course(place, part, 10)
    true = np.stack([np.cos(part * np.pi / 2), -np.sin(part * np.pi / 2)], axis=1)
    # Splines end straight: slopes lag there by what a circle of 300 px turns by over a mean of 21 px.
    assert np.abs(goes.ahead - true)[[0, -1]].max() < 21.0 / 300.0
    assert np.abs(goes.ahead - true)[1:-1].max() < 0.01
    assert np.abs(np.linalg.norm(goes.place, axis=1) - 300.0)[1:-1].max() < 1.0


def test_a_crack_is_led_on_as_all_of_it_goes(rng: np.random.Generator) -> None:
    """Its last 10 px, where hardly anything has opened, may be 3 px astray: 250 px ahead that are 8 px."""
    along = np.arange(256.0)
    stray = np.where(along < 245.0, 0.0, 0.3 * (along - 245.0)) + rng.normal(0.0, 0.3, 256)
    tip = _Tip.of(0, np.stack([along, 255.5 + stray], axis=1), 10)
    assert abs(tip.ahead[1]) < 8.0 / 250.0


def test_jumps_by_chance_are_one_in_a_thousand_images() -> None:
    """As many subsets as fit in, u and v, in either sense."""
    least = _least_jump(512 * 512, 10)
    assert 4.0 * (512 / 21) ** 2 * special.ndtr(-least) == pytest.approx(1e-3, rel=1e-6)
    assert _least_jump(100, 10) < least < _least_jump(4 * 512 * 512, 10)
