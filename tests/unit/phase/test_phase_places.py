"""Phases that one camera sees are found in the maps of another, between pixels of one surface alone."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.phase.phase_places import PhaseMap, carried

ROWS, COLUMNS = 40, 48
SIGMA = 1e-4
Y, X = np.mgrid[:ROWS, :COLUMNS].astype(np.float64)


def phases(x: Floats, y: Floats) -> Floats:
    """Return parabolas of two directions that are turned against rows and columns, in rad."""
    u, v = x - 20.0, y - 18.0
    return np.stack(
        [0.010 * u + 0.002 * v + 1e-5 * u * u, -0.003 * u + 0.012 * v + 2e-5 * u * v - 1e-5 * v * v]
    )


def map_of(omega: Floats, usable: Mask | None = None, sigma: float = SIGMA) -> PhaseMap:
    known = np.ones(omega.shape[1:], dtype=bool) if usable is None else usable
    return PhaseMap(omega, np.full(omega.shape, sigma, np.float32), known)


def sigma_of(count: int) -> np.ndarray:
    return np.full((2, count), SIGMA, np.float32)


def test_parabolas_are_inverted_exactly(rng: np.random.Generator) -> None:
    place = rng.uniform([5.0, 5.0], [COLUMNS - 6.0, ROWS - 6.0], (500, 2)).T
    found = map_of(phases(X, Y)).find(phases(*place), sigma_of(500))
    # Nine pixels tell a parabola exactly, and Newton's third step leaves rounding of float64.
    np.testing.assert_allclose(found.place, place, atol=1e-9)


def test_places_move_with_the_phases_that_are_looked_for(rng: np.random.Generator) -> None:
    place = rng.uniform([8.0, 8.0], [COLUMNS - 9.0, ROWS - 9.0], (100, 2)).T
    known, at, step = map_of(phases(X, Y)), phases(*place), 1e-5
    found = known.find(at, sigma_of(100))
    for k in range(2):
        beside = at.copy()
        beside[k] += step
        moved = (known.find(beside, sigma_of(100)).place - found.place) / step
        # The difference quotient is off by the bend: 1e-3 px of slope a px, times a thousandth of a px.
        np.testing.assert_allclose(found.by_omega[:, k], moved, rtol=1e-3, atol=1e-2)


def test_more_directions_are_weighted_and_do_better(rng: np.random.Generator) -> None:
    place = rng.uniform([8.0, 8.0], [COLUMNS - 9.0, ROWS - 9.0], (4000, 2)).T
    third = (phases(X, Y)[0] + phases(X, Y)[1])[None]
    known = map_of(np.concatenate([phases(X, Y), third]))
    exact = phases(*place)
    exact = np.concatenate([exact, exact.sum(axis=0)[None]])
    sigma = np.repeat([[1e-4], [3e-4], [1e-4]], 4000, axis=1).astype(np.float32)
    found = known.find(exact + rng.normal(size=exact.shape) * sigma, sigma)
    off = found.place - place
    stated = np.sqrt(np.sum(np.square(found.by_omega * sigma), axis=1))
    # The standard deviation of 4000 is known to 1.1 %; four of these.
    np.testing.assert_allclose(np.std(off, axis=1), np.sqrt(np.mean(stated**2, axis=1)), rtol=0.045)


@pytest.mark.parametrize("turned", [False, True])
def test_nothing_is_found_across_a_step(turned: bool) -> None:
    # Along a row three pixels always lie on a parabola, also across a step.
    omega, edge = phases(X, Y), 24
    beyond = (Y if turned else X) >= edge
    omega[:, beyond] += np.array([0.03, 0.02])[:, None]  # 3 px
    middles = map_of(omega).middles
    lines = np.asarray(middles.any(axis=1 if turned else 0))
    assert not lines[edge - 2 : edge + 2].any()
    assert lines[edge - 4]
    assert lines[edge + 4]
    # What lies between the two sides, as of a part that is hidden, is nowhere.
    inside = np.stack([np.full(5, edge - 0.5), np.linspace(10.0, 25.0, 5)])
    at = phases(*(inside[::-1] if turned else inside)) + np.array([[0.015], [0.01]])
    assert np.isnan(map_of(omega).find(at, sigma_of(5)).place).all()


def test_noise_loses_no_middles_and_rims_are_left_out(rng: np.random.Generator) -> None:
    usable = (X - 24.0) ** 2 + (Y - 20.0) ** 2 < 15.0**2
    omega = phases(X, Y) + SIGMA * rng.normal(size=(2, ROWS, COLUMNS))
    middles = map_of(omega, usable).middles
    inner = (X - 24.0) ** 2 + (Y - 20.0) ** 2 < 12.0**2
    outer = (X - 24.0) ** 2 + (Y - 20.0) ** 2 > 14.0**2
    assert middles[inner].all()
    assert not middles[outer].any()


def test_nothing_is_known_of_phases_that_nobody_sees() -> None:
    known = map_of(phases(X, Y))
    far = np.array([[5.0, np.nan], [5.0, 0.0]])
    assert np.isnan(known.find(far, sigma_of(2)).place).all()
    nowhere = map_of(phases(X, Y), np.zeros((ROWS, COLUMNS), dtype=bool))
    assert np.isnan(nowhere.find(phases(X[5:6, 5], Y[5:6, 5]), sigma_of(1)).place).all()


def test_fields_are_carried_linearly() -> None:
    place = np.array([[3.25, np.nan], [7.5, 2.0]])
    np.testing.assert_allclose(carried(np.stack([X, X + 2.0 * Y]), place)[:, 0], [3.25, 18.25], atol=1e-12)
    assert np.isnan(carried(X[None], place)[0, 1])
