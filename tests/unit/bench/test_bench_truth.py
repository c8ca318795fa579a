"""The pairs on which correlation breaks are true, and nothing that is wrong in them is called valid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.bench.correlated.truth_pairs import READ_NOISE, TruthPair, pairs
from sms_jobs.bench.groups.truth import crack_openings, judged, judged_crack, matched
from sms_jobs.testing.shelf import Shelf

ShelfOf = Callable[[TruthPair], Shelf]
SEED = 7


@pytest.fixture(scope="module")
def made() -> dict[str, TruthPair]:
    found = [make() for make in pairs(SEED, quick=True)]
    return {f"{pair.group}, {pair.name}": pair for pair in found}


@pytest.fixture(scope="module")
def shelf_of(made: dict[str, TruthPair]) -> ShelfOf:
    """Return what matches a pair that was made, each once: several tests judge the cracks."""
    found: dict[str, Shelf] = {}

    def shelf_of(pair: TruthPair) -> Shelf:
        name = f"{pair.group}, {pair.name}"
        assert made[name] is pair
        if name not in found:
            found[name] = matched(pair, 1)
        return found[name]

    return shelf_of


def test_the_second_image_shows_what_the_displacement_says(made: dict[str, TruthPair]) -> None:
    """Carried back along it, it differs from the first by the noise of both: 28 levels, less what the spline
    smooths of the second's, whose part is 0.5 to 1 of its variance."""
    assert len(made) == 14
    for name, pair in made.items():
        if pair.group in {"blur", "light", "dust", "bad_pixels"}:
            continue  # light, focus and the sensor's own pattern are no displacement
        row, column = np.mgrid[0:512, 0:512].astype(np.float64)
        u, v = np.nan_to_num(pair.displacement)
        back = ndimage.map_coordinates(pair.deformed.astype(np.float64), [row + v, column + u], order=5)
        known = np.isfinite(pair.displacement).all(axis=0)
        # Pixels that mix both sides of a crack or of an outline are no material point.
        across = row if "ends" in name else column
        known &= ndimage.minimum_filter(known, 9) & (np.abs(across - 255.5) > 4.0)
        known[:30], known[-30:], known[:, :30], known[:, -30:] = False, False, False, False
        left = (back - pair.reference)[known]
        assert READ_NOISE * np.sqrt(1.4) < np.std(left) < READ_NOISE * np.sqrt(2.05), name
        assert abs(np.mean(left)) < 0.5, name


@pytest.mark.parametrize("group", ["sine", "crack", "dust", "bad_pixels", "outline"])
def test_what_is_wrong_is_not_called_valid(made: dict[str, TruthPair], shelf_of: ShelfOf, group: str) -> None:
    """At most a hundred in a million: what is left lies together, in one place of a pair or none."""
    found = [judged(pair, shelf_of(pair)) for pair in made.values() if pair.group == group]
    valid = sum(one.valid for one in found)
    assert valid > 0.3 * sum(one.seen for one in found)
    assert sum(one.silent for one in found) <= 1e-4 * valid


def test_a_grid_that_may_be_a_period_off_has_no_value(made: dict[str, TruthPair], shelf_of: ShelfOf) -> None:
    (pair,) = (pair for pair in made.values() if pair.group == "grid")
    assert judged(pair, shelf_of(pair)).valid == 0


def test_what_a_crack_has_opened_by_is_told(made: dict[str, TruthPair], shelf_of: ShelfOf) -> None:
    """Strips of 30 px know the sides to 0.02 px each, by noise, and fifty of them agree on an even opening: a
    line through them has 0.007 px, and what they cannot rule out 0.01 px. Strain keeps to its side: its
    deviation holds."""
    cracks = [judged_crack(pair.slip, shelf_of(pair)) for pair in made.values() if pair.slip is not None]
    assert len(cracks) == 3
    for one in cracks:
        assert len(one.opening) > 45
        assert np.sqrt(np.mean(one.opening**2)) < 0.02
        assert abs(np.median(one.opening)) < 0.01
        assert np.sqrt(np.mean(one.score**2)) < 2.0
        assert abs(np.median(one.sliding)) < 0.03
        assert 0.7 < np.sqrt(np.mean(one.strain**2)) < 1.3


def test_a_crack_that_ends_has_not_opened_ahead_of_its_tip(
    made: dict[str, TruthPair], shelf_of: ShelfOf
) -> None:
    """Its line is led on to the border; planes see an opening up to 30 px ahead of where it begins."""
    (pair,) = (pair for name, pair in made.items() if "ends" in name)
    found = crack_openings(shelf_of(pair))
    true = 2.0 * np.sqrt(np.maximum(256.0 - found.pixel[:, 0], 0.0) / 256.0)
    score = (found.opening - true) / found.sigma_opening
    assert found.pixel[:, 0].max() > 480.0
    assert np.abs(score).max() < 6.0
    assert np.sqrt(np.mean(score**2)) < 1.7
