"""What people and strangers write is shown as it is, and steers neither the terminal nor the program."""

from __future__ import annotations

import json

import pytest

from sms_jobs.cli import output
from sms_jobs.errors import InvalidInput
from sms_jobs.records.texts import checked_text, harmless

ODD = ("[/x]", "\\[/x]", "\\\\[/x]", "[bold]a", "[link=file:///x]a[/link]", ":smile:", "ends in \\")
STEERING = (
    "\x1b[31mred",
    "\x9b31m",
    "\x1b]0;title\x07",
    "a\rb",
    "a\x7fb",
    "\u202eback",
    "\udcff",
    "\x00",
    "\u2028",
)


@pytest.mark.parametrize("text", ODD)
def test_what_looks_like_an_instruction_is_printed_letter_by_letter(
    text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    output.print_table(["name", text], [(text, 1)], empty="")
    output.print_facts({text: text})
    output.say(text)
    output.say_error(text)
    output.print_sentence(text)
    told = capsys.readouterr()
    assert told.out.count(text) == 5
    assert told.err.count(text) == 2


@pytest.mark.parametrize("text", STEERING)
def test_nothing_reaches_the_terminal_that_steers_it(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    output.print_table([text], [(text,)], empty="")
    output.print_facts({text: text})
    output.print_text(f"{text}\n")
    output.print_json({"text": text})
    output.say(text)
    output.say_error(text)
    told = "".join(capsys.readouterr())
    assert all(letter.isprintable() or letter == "\n" for letter in told)
    shown = [line for line in told.splitlines() if line.startswith("{")]
    assert json.loads(shown[0])["text"] == text


def test_a_letter_that_cannot_be_printed_is_shown_by_its_number() -> None:
    assert harmless("a\x1b[2J\x9b\u202e\udcff") == "a\\x1b[2J\\x9b\\u202e\\xff"
    assert harmless("two\r\nlines\tand \u00e4 \U0001f527") == "two\r\nlines\tand \u00e4 \U0001f527"


def test_an_endless_refusal_is_cut(capsys: pytest.CaptureFixture[str]) -> None:
    output.say_error("there is no campaign '" + "a" * 100_000 + "'; see 'sms campaign list'")
    told = capsys.readouterr().err
    assert len(told) < 2_100
    assert told.startswith("error: there is no campaign 'aaa")
    assert "see 'sms campaign list'" in told


@pytest.mark.parametrize("text", STEERING)
def test_what_cannot_be_printed_is_not_stored(text: str) -> None:
    with pytest.raises(InvalidInput, match="the reason holds"):
        checked_text(text, "the reason")
    with pytest.raises(InvalidInput, match="10001 letters"):
        checked_text("a" * 10_001, "the reason")
    assert checked_text("\u00e4\n\t\U0001f527", "the reason") == "\u00e4\n\t\U0001f527"


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (20_000.0, "20000"),
        (-12_345.6, "-12346"),
        (9_876.54, "9877"),
        (0.000123456, "0.0001235"),
        (2e8, "2e+08"),
        (None, "-"),
    ],
)
def test_loads_are_told_as_they_are_given(value: float | None, told: str) -> None:
    assert output.shown(value) == told
