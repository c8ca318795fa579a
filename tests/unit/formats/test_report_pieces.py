"""The pieces of a report: what is escaped, how numbers look, and which way columns lean."""

from __future__ import annotations

import base64

import pytest

from sms_jobs.formats.report.html import (
    NOTHING,
    Given,
    Markup,
    code,
    facts,
    figure,
    number,
    paragraph,
    table,
)
from sms_jobs.formats.report.page import Section, page


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (0.0123456, "0.01235"),
        (1234.56, "1235"),
        (24996.4, "24996"),
        (-5e-7, "-5e-07"),
        (7, "7"),
        (0.0, "0"),
        (float("nan"), NOTHING),
        (float("inf"), NOTHING),
        (None, NOTHING),
        (Given(1234.5678), "1234.5678"),
        (Given(0.1), "0.1"),
    ],
)
def test_numbers_are_short_and_never_more_exact_than_they_are(value: float | None, shown: str) -> None:
    assert number(value) == shown


def test_everything_plain_is_escaped() -> None:
    evil = "<b>\"'&"
    safe = "&lt;b&gt;&quot;&#x27;&amp;"
    parts = [
        paragraph(evil),
        code(evil, title=evil),
        table([evil], [[evil]]),
        facts([(evil, evil)]),
        figure(b"", evil),
        Markup(page(evil, [], [Section(evil, [])])),
    ]
    for part in parts:
        assert evil not in part.html
        assert safe in part.html


def test_columns_of_numbers_lean_right() -> None:
    made = table(["name", "load", "mixed"], [["a", 1.0, 2.0], ["b", None, "x"]]).html
    assert '<th scope="col">name</th><th scope="col" class=number>load</th><th scope="col">mixed</th>' in made
    assert f'<td class="number">{NOTHING}</td><td>x</td>' in made


def test_pictures_are_inside_the_page() -> None:
    made = figure(b"picture", "what it shows").html
    assert base64.b64encode(b"picture").decode() in made
    assert 'alt="what it shows"' in made


def test_facts_that_say_nothing_are_left_out() -> None:
    assert "material" not in facts([("material", ""), ("specimen", "x")]).html
