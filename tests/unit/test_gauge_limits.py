"""Limits of gauges as people type them."""

from __future__ import annotations

import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.records.gauge_limits import GaugeLimit, gauge_limit


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("g1.extension_mm > 0.5mm", GaugeLimit("g1", "extension_mm", True, 0.5)),
        ("g1.extension_mm>500 um", GaugeLimit("g1", "extension_mm", True, 0.5)),
        (" G-2.z_mm < -2mm ", GaugeLimit("G-2", "z_mm", False, -2.0)),
        ("mid.span.x_mm < 0.01m", GaugeLimit("mid.span", "x_mm", False, 10.0)),
    ],
)
def test_a_limit_has_gauge_quantity_and_unit(text: str, limit: GaugeLimit) -> None:
    found = gauge_limit(text, "it")
    assert (found.gauge, found.quantity, found.above) == (limit.gauge, limit.quantity, limit.above)
    assert found.limit == pytest.approx(limit.limit, rel=1e-15)  # rounding of one product
    assert GaugeLimit.from_json(found.as_json()) == found


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("g1.extension_mm > 0.5", "which has no unit: write it in mm"),
        ("g1.extension_mm > 5kN", "'kN' is no unit of it"),
        ("g1.strain > 5mm", "no limit of a gauge: write GAUGE.extension_mm > 0.5mm"),
        ("extension_mm > 5mm", "no limit of a gauge"),
        ("g1.extension_mm = 5mm", "no limit of a gauge"),
        ("", "no limit of a gauge"),
    ],
)
def test_what_is_not_clear_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(InvalidInput, match=complaint):
        gauge_limit(text, "--stop-if")


def test_a_limit_is_reached_beyond_it() -> None:
    above, below = GaugeLimit("g", "x_mm", True, 1.0), GaugeLimit("g", "x_mm", False, 1.0)
    assert [above.is_reached(value) for value in (0.9, 1.0, 1.1)] == [False, False, True]
    assert [below.is_reached(value) for value in (0.9, 1.0, 1.1)] == [True, False, False]
