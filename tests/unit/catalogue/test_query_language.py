"""The query language: what is written is what is asked, and what is wrong is pointed at."""

from __future__ import annotations

from contextlib import suppress
from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sms_jobs.catalogue.queries.language import (
    DEEPEST,
    LONGEST_TEXT,
    AllOf,
    AnyOf,
    Between,
    Comparison,
    Condition,
    Membership,
    Name,
    Not,
    Operator,
    Value,
    comparisons,
    conjuncts,
    parse,
    values_of,
)
from sms_jobs.catalogue.queries.quantities import in_other_units
from sms_jobs.errors import InvalidInput


def written(condition: Condition) -> str:
    """Write a condition down with a view of parentheses around all that is in another."""
    if isinstance(condition, Not):
        return f"not ({written(condition.condition)})"
    if isinstance(condition, AllOf | AnyOf):
        word = " and " if isinstance(condition, AllOf) else " OR "
        return word.join(f"({written(part)})" for part in condition.conditions)
    if isinstance(condition, Membership):
        return f"{condition.name.text} In ({', '.join(value(v) for v in condition.values)})"
    if isinstance(condition, Between):
        return f"{condition.name.text} between {value(condition.low)} and {value(condition.high)}"
    return f"{condition.name.text}{condition.operator.value}{value(condition.value)}"


def value(one: Value) -> str:
    if isinstance(one.value, str):
        return "'" + one.text.replace("'", "''") + "'"
    return f"{one.text} {one.unit}".rstrip()


def meaning(condition: Condition) -> object:
    """Return a condition without the places in the text."""
    if isinstance(condition, Not):
        return ("not", meaning(condition.condition))
    if isinstance(condition, AllOf | AnyOf):
        return (type(condition), [meaning(part) for part in condition.conditions])
    sort = "in" if isinstance(condition, Membership) else getattr(condition, "operator", "between")
    return (condition.name.text, sort, [(v.value, v.unit) for v in values_of(condition)])


names = st.sampled_from(["load_kN", "max_principal", "channel.temp_c", "param.method", "Où"]).map(
    lambda text: Name(text, 0)
)
units = st.sampled_from(["", "kN", "\u00b5m"])
numbers = st.builds(lambda x, unit: Value(x, repr(x), 0, unit), st.floats(-1e12, 1e12), units)
texts = st.text(st.characters(blacklist_characters="\0", blacklist_categories=("Cs",)), max_size=8).map(
    lambda text: Value(text, text, 0)
)
written_times = st.integers(400, 47_000).map(
    lambda day: (datetime.fromisoformat("1970-01-01T08:15") + timedelta(days=day)).isoformat()
)
times = written_times.map(lambda text: Value(datetime.fromisoformat(text).astimezone(), text, 0))
values = st.one_of(numbers, texts, times)
leaves = st.one_of(
    st.builds(Comparison, names, st.sampled_from(Operator), values),
    st.builds(Membership, names, st.lists(values, min_size=1, max_size=3).map(tuple)),
    st.builds(Between, names, values, values),
)
conditions = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.builds(Not, inner),
        st.builds(AllOf, st.lists(inner, min_size=2, max_size=3).map(tuple)),
        st.builds(AnyOf, st.lists(inner, min_size=2, max_size=3).map(tuple)),
    ),
    max_leaves=8,
)


@given(conditions)
def test_what_is_written_is_read_again(condition: Condition) -> None:
    found = parse(f"strain where {written(condition)}")
    assert found.kind is not None
    assert found.kind.text == "strain"
    assert found.condition is not None
    assert meaning(found.condition) == meaning(condition)


@given(st.text(max_size=60))
def test_any_text_is_a_query_or_refused(text: str) -> None:
    # Whatever else is raised would be a defect.
    with suppress(InvalidInput):
        assert parse(text).text == text


def test_and_binds_closer_than_or_and_not_closest() -> None:
    condition = parse("a = 1 or not b = 2 and c = 3").condition
    assert isinstance(condition, AnyOf)
    assert isinstance(condition.conditions[0], Comparison)
    both = condition.conditions[1]
    assert isinstance(both, AllOf)
    assert isinstance(both.conditions[0], Not)
    assert [t.name.text for t in comparisons(condition)] == ["a", "b", "c"]
    assert conjuncts(condition) == (condition,)
    assert len(conjuncts(parse("a = 1 and (b = 2 and c = 3)").condition)) == 3


@pytest.mark.parametrize(
    ("text", "kind", "asks"),
    [
        ("", None, False),
        ("strain", "strain", False),
        ("observe-board", "observe-board", False),
        ("strain where a = 1", "strain", True),
        ("where a = 1", None, True),
        ("WHERE a = 1", None, True),
        ("a = 1", None, True),
        ("state in (S01, 'S 02')", None, True),
    ],
)
def test_the_kind_may_be_left_out_and_so_may_the_condition(text: str, kind: str | None, asks: bool) -> None:
    found = parse(text)
    assert (found.kind and found.kind.text) == kind
    assert (found.condition is not None) is asks


def test_times_without_a_zone_are_local() -> None:
    for text, meant in (
        ("2026-05-01T12:30", datetime.fromisoformat("2026-05-01T12:30").astimezone()),
        ("2026-05-01T12:30+02:00", datetime(2026, 5, 1, 10, 30, tzinfo=UTC)),
        ("2026-05-01T10:30Z", datetime(2026, 5, 1, 10, 30, tzinfo=UTC)),
    ):
        (test,) = comparisons(parse(f"time >= {text}").condition)
        assert isinstance(test, Comparison)
        assert test.value.value == meant


def test_a_month_begins_with_its_first_day_and_a_year_is_a_number() -> None:
    for text in ("time in 2026-05", "time in (2026-05)", "time = 2026-05"):
        (test,) = comparisons(parse(text).condition)
        (month,) = values_of(test)
        assert month.value == datetime.fromisoformat("2026-05-01").astimezone()
        assert month.text == "2026-05"
    (test,) = comparisons(parse("time in 2026").condition)
    assert [v.value for v in values_of(test)] == [2026.0]


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ("strain where", 13, "the name of something"),
        ("strain whre a = 1", 8, "after|'and'|where|one of"),
        ("strain where load_kN >", 23, "a number, a time or a text"),
        ("strain where load_kN > 3 view = C1P1", 26, "'and', 'or' or the end"),
        ("a in 3", 6, "a list in parentheses"),
        ("a in (3", 8, "a comma or the closing parenthesis"),
        ("a between 3 or 4", 13, "'and' and the upper end"),
        ("(a = 3", 7, "a closing parenthesis"),
        ("a = 'S01", 5, "not closed"),
        ("a = 10mm", 5, "neither a number nor a time"),
        ("a = 2026-02-30", 5, "does not exist"),
        ("a in 2026-13", 6, "does not exist"),
        ("a > 5 kN kN", 7, "'and', 'or' or the end"),
        ("a & b", 3, "no meaning here"),
        ("a not = 3", 7, "'in' or 'between'"),
        ("a = 1e999", 5, "too large"),
        ("a = 1 and or b = 2", 11, "the name of something"),
    ],
)
def test_what_is_wrong_is_pointed_at(text: str, place: int, words: str) -> None:
    with pytest.raises(InvalidInput, match=words) as refused:
        parse(text)
    # The first word of "strain whre" is a name, after which a test was expected.
    assert f"at character {place} of the query" in str(refused.value)
    assert ">>>" in str(refused.value)


def test_a_query_has_an_end() -> None:
    with pytest.raises(InvalidInput, match=f"{LONGEST_TEXT} are the most"):
        parse("a = 1 or " * LONGEST_TEXT)
    with pytest.raises(InvalidInput, match=f"more than {DEEPEST} deep"):
        parse("(" * 200 + "a = 1" + ")" * 200)
    with pytest.raises(InvalidInput, match="null"):
        parse("a = '\0'")


def test_units_are_converted_there_and_back() -> None:
    known = dict(in_other_units("load_kN"))
    assert known["load_n"] == 1000.0
    for name in ("load_n", "gauge_mm", "tilt_deg", "maximum_principal_strain", "size_mb"):
        for other, factor in in_other_units(name):
            back = dict(in_other_units(other))[name.lower()]
            assert factor * back == pytest.approx(1.0, rel=1e-15)
    assert dict(in_other_units("maximum_principal_microstrain"))["maximum_principal_strain"] == 1e-6
    assert list(in_other_units("valid_fraction")) == []
    assert list(in_other_units("mm")) == []
