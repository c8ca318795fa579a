"""docs/equations.md names functions and tests that exist, and leaves no cited equation out."""

from __future__ import annotations

import ast
import importlib
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MAP = ROOT / "docs" / "equations.md"
NUMBER = re.compile(r"\((\d+\.\d+)\)")
CITATION = re.compile(r"Eq\.\s((?:\(\d+\.\d+\)(?:\s?-\s?|,\s|\sand\s)?)+)")
"""'Eq. (1.7)-(1.12) and (1.21)-(1.23)': only the thesis numbers equations by chapter."""


@dataclass(frozen=True)
class Row:
    equation: str
    source: str
    function: str
    test: str


def rows() -> list[Row]:
    """Return the rows of the map; functions and tests without their backticks."""
    found = []
    for line in MAP.read_text(encoding="utf-8").splitlines():
        if not line.startswith("|") or line.startswith(("| equation |", "|---")):
            continue
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert len(cells) == 4, f"not a row of four cells: {line}"
        found.append(Row(cells[0], cells[1], cells[2].strip("`"), cells[3].strip("`")))
    return found


ROWS = rows()


@cache
def definitions(path: Path) -> dict[str, str]:
    """Return the docstring of each function, class and method of a file, by dotted name."""
    found: dict[str, str] = {}

    def collect(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found[prefix + node.name] = ast.get_docstring(node) or ""
                collect(node.body, f"{prefix}{node.name}.")

    collect(ast.parse(path.read_text(encoding="utf-8")).body, "")
    return found


def cited(docstring: str) -> set[str]:
    """Return the numbers of the thesis's equations that a docstring cites."""
    joined = " ".join(docstring.split())
    return {number for group in CITATION.findall(joined) for number in NUMBER.findall(group)}


def test_the_map_has_rows() -> None:
    assert len(ROWS) > 10
    assert len(set(ROWS)) == len(ROWS)


def test_every_function_and_test_of_the_map_exists() -> None:
    assert [row for row in ROWS if not exists(row)] == []


def exists(row: Row) -> bool:
    """Say whether a row is complete, and names a function and a test that there are."""
    path, _, name = row.function.partition(":")
    found = importlib.import_module(path.removesuffix(".py").replace("/", "."))
    for part in name.split("."):
        found = getattr(found, part, None)
    file, _, test = row.test.partition("::")
    named = test.replace("::", ".") in definitions(ROOT / file)
    return bool(row.equation and row.source and callable(found) and named)


def test_every_cited_equation_is_in_the_map() -> None:
    missing = {}
    for path in sorted((ROOT / "sms_jobs" / "metrology").rglob("*.py")):
        for name, docstring in definitions(path).items():
            function = f"{path.relative_to(ROOT).as_posix()}:{name}"
            sources = [row.source for row in ROWS if row.function == function and "thesis" in row.source]
            mapped = {number for source in sources for number in NUMBER.findall(source)}
            if cited(docstring) - mapped:
                missing[function] = sorted(cited(docstring) - mapped)
    # docs/equations.md has no row for these.
    assert missing == {}


def test_citations_are_found_as_people_write_them() -> None:
    text = (
        "Thesis Eq. (1.7)-(1.12) and (1.21)-(1.23), in pixels.\nThe thesis's Eq. (1.22) is\nits radial part."
    )
    assert cited(text) == {"1.7", "1.12", "1.21", "1.23", "1.22"}
    assert cited("Pan et al. 2013, Eq. (7)") == set()
