"""The studies of gloss and of the projector's response find what the library's tests find."""

from __future__ import annotations

import pytest

from sms_jobs.bench.studies import glossy_surface, projector_response


def test_what_one_exposure_loses_an_adaptive_one_measures() -> None:
    planned, adaptive = (
        glossy_surface.judged("temporal-unwrapping", how).row() for how in ("none", "projector")
    )
    assert planned[0] < 80.0 < 99.0 < adaptive[0]  # type: ignore[operator]
    # The same light for every pixel that was in range: the rms is that of one exposure within a tenth.
    assert adaptive[1] == pytest.approx(planned[1], rel=0.1)


def test_the_ripple_is_stated_before_and_gone_after() -> None:
    kept, before, missed, kept_after, after, score = projector_response.judged(1.3, 3, "temporal-unwrapping")
    assert kept == 0.0
    assert kept_after > 99.0  # type: ignore[operator]
    assert before > 4.0 * after  # type: ignore[operator]
    # It is stated where it is left in, as one of few pixels tell it: to a tenth.
    assert missed == pytest.approx(1.0, abs=0.1)
    assert score == pytest.approx(1.0, abs=0.04)  # 9700 pixels: 0.7 %; and what their blur does
