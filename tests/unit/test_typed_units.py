"""Quantities as people type them: with a unit of their own, or refused."""

from __future__ import annotations

import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.records.units import duration_s, in_unit_of_name, time_words, typed


@pytest.mark.parametrize(
    ("text", "unit", "number"),
    [
        ("20kN", "N", 20_000.0),
        ("20 kN", "kN", 20.0),
        ("-1.5e3 N", "kN", -1.5),
        (".5kN", "N", 500.0),
        ("15min", "s", 900.0),
        ("250ms", "s", 0.25),
        ("300um", "mm", 0.3),
        ("0.5degC", "degC", 0.5),
        ("3", "1", 3.0),
    ],
)
def test_a_unit_is_converted_within_its_family(text: str, unit: str, number: float) -> None:
    assert typed(text, "it").in_unit(unit, "it") == pytest.approx(number, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "unit", "complaint"),
    [
        ("500", "N", "has no unit: write it in N, kN, MN, such as 500N"),
        ("500mm", "N", "'mm' is no unit of it"),
        ("15m", "s", "'m' is no unit of it: write it in s, ms, min, h"),  # minutes, or metres?
        ("5mN", "N", "'mN' is no unit of it"),
        ("5kn", "N", "'kn' is no unit of it"),
        ("5K", "degC", "'K' is no unit of it: write it in degC"),
        ("kN", "N", "is no quantity: write a number and its unit, such as 10s, 0.5mm or 20kN"),
        ("", "N", "is no quantity"),
        ("1,5kN", "N", "'.5kN' is no unit|no unit of it|is no quantity"),
        ("nan N", "N", "is no quantity"),
        ("1e999N", "N", "should be between"),
    ],
)
def test_what_is_not_clear_is_refused(text: str, unit: str, complaint: str) -> None:
    with pytest.raises(InvalidInput, match=complaint):
        typed(text, "--load").in_unit(unit, "--load")


def test_a_time_has_bounds() -> None:
    assert duration_s("2h", "--every", 1.0, 1e5) == 7200.0
    with pytest.raises(InvalidInput, match="between 1 and"):
        duration_s("10ms", "--every", 1.0, 1e5)
    assert [time_words(s) for s in (900.0, 7200.0, 90.0, 0.0, 0.5)] == [
        "15 min",
        "2 h",
        "90 s",
        "0 s",
        "0.5 s",
    ]


@pytest.mark.parametrize(
    ("name", "unit", "expected"),
    [
        ("load_n", "kN", 20_000.0),
        ("load_kN", "N", 0.02),
        ("load_n", "N", 20.0),
        ("crack_mm", "um", 0.02),
        ("load_n", "mm", 20.0),  # another quantity, which nobody can convert
        ("cycles", "1", 20.0),
        ("temperature", "degC", 20.0),
    ],
)
def test_a_reading_comes_into_the_unit_of_its_name(name: str, unit: str, expected: float) -> None:
    assert in_unit_of_name(name, 20.0, unit) == pytest.approx(expected, rel=1e-15)
