"""Tables at any width of the terminal: nothing that they tell is cut off."""

from __future__ import annotations

import io
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from sms_jobs.cli import output
from sms_jobs.cli.output import answer
from sms_jobs.cli.tables import fitted

COLUMNS = ("file", "kind", "subject", "type", "size", "created")
ROWS = (
    ("1234567", "reconstruct", "top-hat-demo/S01/C1P1", ".h5", "12.3 MB", "2026-05-04 12:00:00"),
    ("12345", "report", "top-hat-demo", ".html", "1.1 MB", "2026-05-04 12:00:01"),
)


def printed(columns: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> str:
    screen = io.StringIO()
    Console(file=screen, width=width, markup=False, highlight=False).print(fitted(columns, rows, width))
    return screen.getvalue()


@pytest.mark.parametrize("width", [72, 80, 100])
def test_subjects_stand_on_one_line(width: int) -> None:
    assert "top-hat-demo/S01/C1P1" in printed(COLUMNS, ROWS, width)


def test_a_terminal_that_was_made_wider_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    for width in (80, 120):
        monkeypatch.setenv("COLUMNS", str(width))
        assert answer().width == width


def test_names_stay_whole_and_sentences_are_broken() -> None:
    row = ("campaign-with-a-long-name/S01/C1P1", "the rig needs the machine until the evening", "failed")
    lines = printed(("subject", "reason", "outcome-of-it"), [row], 60).splitlines()
    assert "campaign-with-a-long-name/S01/C1P1" in lines[1]
    assert "failed" in lines[1]
    assert len(lines) > 2


words = st.text(st.characters(codec="ascii", categories=("L", "N", "P")), min_size=1, max_size=40)


@given(
    rows=st.lists(st.tuples(words, words, words, words), min_size=1, max_size=4),
    width=st.integers(20, 120),
)
def test_nothing_is_cut(rows: list[tuple[str, str, str, str]], width: int) -> None:
    """Every letter of every cell is printed, and none besides."""
    columns = ("subject", "kind", "path", "note")
    shown = printed(columns, rows, width)
    assert all(len(line.rstrip()) <= width for line in shown.splitlines())
    letters = sorted("".join(shown.split()))
    assert letters == sorted("".join(text for row in (columns, *rows) for text in row))


@pytest.mark.parametrize("columns", ["0", "1", "19", "", "many"])
def test_a_width_in_which_nothing_can_be_shown_counts_as_none(
    columns: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    output.print_table(["campaign", "states"], [("wing-fatigue-of-the-left-panel", 12)], empty="")
    assert "wing-fatigue-of-the-left-panel" in capsys.readouterr().out
