"""README and documents quote commands that there are, and figures that a machine has written."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from support.documents import complaint, disagreements, figure_tables, quoted

from sms_jobs.bench.groups import all_groups
from sms_jobs.bench.studies import all_studies
from sms_jobs.records.shown.notifications import TOPICS

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "ARCHITECTURE.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "ops" / "runbook.md",
    # Records of decisions are left as they were made.
    *sorted((ROOT / "docs").glob("*.md")),
]
STORED = ROOT / "docs" / "studies"


def named(document: Path) -> str:
    return str(document.relative_to(ROOT))


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_every_command_that_is_quoted_exists_and_takes_its_options(document: Path) -> None:
    found = {command: complaint(command) for command in quoted(document.read_text(encoding="utf-8"))}
    assert len(found) > 10 or document.name not in ("README.md", "runbook.md", "operations.md")
    assert {command: words for command, words in found.items() if words} == {}


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_every_file_and_group_of_figures_that_is_quoted_exists(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    quotes = " ".join(re.findall(r"`[^`]+`", text))
    files = set(re.findall(r"\b(?:tests|docs)/[\w/.-]*\w\.(?:py|md|toml)\b", quotes))
    assert {file for file in files if not (ROOT / file).exists()} == set()
    for command in quoted(text):
        words = command.split()
        if words[0] in ("bench", "study"):
            known = {"bench": all_groups(), "study": all_studies()}[words[0]]
            meant = [w for w in words[1:] if re.fullmatch(r"[a-z][a-z0-9-]+", w)]
            assert set(meant) <= {*known, "list"}, command


def test_commands_are_found_and_what_is_wrong_with_them_is_said() -> None:
    text = "`sms data find 'a | b' --limit 3`\n\n```\nsms up &\n$ sms job list \\\n>   -c x | cat\n```\n"
    assert [c.strip() for c in quoted(text)] == ["up", "job list  -c x", "data find 'a | b' --limit 3"]
    assert complaint("data find --kind strain") == complaint("job submit strain --gauge-length-mm 10") == ""
    for wrong, words in {
        "dato find": "no command 'dato'",
        "data fynd": "no command 'data fynd'",
        "data find --kin strain": "No such option",
        "job submit strain --radius 3": "has the parameter --radius",
        "up twice": "does not take 'twice'",
    }.items():
        assert words in complaint(wrong)


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_figures_are_those_that_a_study_has_written(document: Path) -> None:
    for table in figure_tables(document.read_text(encoding="utf-8")):
        assert disagreements(table, STORED) == []


def test_every_stored_study_is_told() -> None:
    told = {t.file for d in DOCUMENTS for t in figure_tables(d.read_text(encoding="utf-8"))}
    assert told == {path.name for path in STORED.glob("*.json")} != set()
    assert {name.removesuffix(".json") for name in told} <= set(all_studies())


def test_a_figure_that_is_not_the_studys_is_noticed(tmp_path: Path) -> None:
    rows = [{"x": 1.0, "rms": 0.1234, "found": 0.98}, {"x": 2.0, "rms": None, "found": 0.0}]
    (tmp_path / "a.json").write_text(json.dumps({"rows": rows}))
    text = "<!-- a.json:\n| x | rms; found | -->\n| x | both |\n|---|---|\n| 1 | {} |\n| 2 | |\n"
    for told, agrees in (("0.123; 98 %", True), ("0.12; 0.98", True), ("0.124; 98 %", False), ("", False)):
        (table,) = figure_tables(text.replace("{}", told))
        assert (disagreements(table, tmp_path) == []) is agrees
    (table,) = figure_tables(text.replace("rms;", "error;"))
    assert "has no column 'error'" in disagreements(table, tmp_path)[0]


def test_every_topic_of_notifications_is_told() -> None:
    text = (ROOT / "docs" / "notifications.md").read_text(encoding="utf-8")
    for topic, told in TOPICS.items():
        assert f"| `{topic.value}` | {told.meaning} |" in text
