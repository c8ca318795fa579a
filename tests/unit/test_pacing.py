"""Open pages take no more than their share of a server, and none rests longer than that asks for."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.web.pacing import LONGEST_REST_S, SHARE, SHORTEST_REST_S, rest_s


@pytest.mark.parametrize("pages", [1, 2, 50, 500])
def test_all_pages_together_take_less_than_their_share(pages: int, rng: np.random.Generator) -> None:
    # Of pages that would rest longer than the longest there is no such promise.
    slowest = LONGEST_REST_S * SHARE / pages
    taken = rng.uniform(0.0, slowest, pages)
    rests = np.array([rest_s(float(one), pages) for one in taken])
    assert (taken / (taken + rests)).sum() < SHARE
    longer = rests > SHORTEST_REST_S
    assert rests[longer] == pytest.approx(pages * taken[longer] / SHARE)


def test_a_quick_page_alone_hardly_rests_and_none_rests_for_ever() -> None:
    assert rest_s(0.01, 1) == rest_s(0.01, 0) == SHORTEST_REST_S
    assert rest_s(10.0, 1000) == LONGEST_REST_S
