"""Discontinuities of exact shapes: at one limit distance finds lower steps than gradient, gap lower ones."""

from __future__ import annotations

import pytest

from sms_jobs.bench.studies.discontinuities import WAYS, Edges, stepped


@pytest.fixture(scope="module")
def low() -> Edges:
    return stepped(4.0)


def test_the_step_is_seen_past_the_plate(low: Edges) -> None:
    # Three sides of 180 x 220 mm at 1.6 mm, foreshortened by 10 degrees and less; the fourth shows its wall.
    pairs = low.across.sum() + low.down.sum()
    assert 2 * 180 * 0.9 + 220 * 0.9 < 1.6 * pairs < 2 * (180 + 220)


def test_with_one_limit_distance_finds_lower_steps_than_gradient_and_gap_lower_ones(low: Edges) -> None:
    found = {way: low.judged(settings, 0.0, 0)[0] for way, settings in WAYS.items()}
    # A step of 4 footprints is a slope of 76 degrees between neighbours, and 0.3 of that is one of 50.
    assert found["gap"] == found["distance, 60"] == found["gradient, 45"] == 1.0
    assert found["distance, 80"] == found["gradient, 80"] == 0.0
    assert found["gradient, 60"] < found["distance, 60"]


def test_noise_disturbs_distance_more_than_gradient(low: Edges) -> None:
    false = {way: low.judged(settings, 0.6, 0)[1] for way, settings in WAYS.items()}
    # Neighbours differ by 0.85 footprints of noise beside a limit of 1.7: 4 in a hundred of four each.
    assert 0.1 < false["distance, 60"] < 0.3
    assert false["gradient, 60"] == false["gap"] == 0.0
    assert false["gradient, 45"] < 0.1 * false["distance, 60"]
