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


def missing_paths(document: str, quotes: str) -> set[str]:
    """Return the files and folders that quotes name but that exist neither at the top nor in the package."""
    package = ROOT / "sms_jobs"
    top = r"(?:sms_jobs|ops|docs|tests|workers|migrations)/[\w/.@-]*\w"
    wanted = {(ROOT, path) for path in re.findall(rf"(?<![\w/.-]){top}", quotes)}
    rooms = "|".join(path.name for path in package.iterdir() if path.is_dir() and path.name.isidentifier())
    # Addresses such as `jobs/wait` look alike; only these two documents have none.
    ending = "" if document in ("ARCHITECTURE.md", "CONTRIBUTING.md") else r"(?:\.py|/)"
    inside = re.findall(rf"`((?:{rooms})/[\w/.-]*[\w/]{ending})`", quotes)
    wanted |= {(package, path) for path in inside}
    return {path for folder, path in wanted if not (ROOT / path).exists() and not (folder / path).exists()}


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_every_file_and_group_of_figures_that_is_quoted_exists(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    quotes = " ".join(re.findall(r"`[^`]+`", text))
    assert missing_paths(document.name, quotes) == set()
    for command in quoted(text):
        words = command.split()
        if words[0] in ("bench", "study"):
            known = {"bench": all_groups(), "study": all_studies()}[words[0]]
            meant = [w for w in words[1:] if re.fullmatch(r"[a-z][a-z0-9-]+", w)]
            assert set(meant) <= {*known, "list"}, command


def test_paths_that_do_not_exist_are_found() -> None:
    quotes = "`records/gone.py` `records/views.py` `sms_jobs/lost` `ops/setup.sh` `jobs/wait`"
    assert missing_paths("http.md", quotes) == {"records/gone.py", "sms_jobs/lost"}
    assert missing_paths("ARCHITECTURE.md", quotes) == {"records/gone.py", "sms_jobs/lost", "jobs/wait"}


def test_decisions_that_change_others_name_each_other() -> None:
    changes, changed = set(), set()
    for path in sorted((ROOT / "docs" / "adr").glob("[0-9]*.md")):
        number, text = int(path.name[:4]), path.read_text(encoding="utf-8")
        changes |= {(number, int(other)) for other in re.findall(r"\bChanges ADR (\d+)", text)}
        changed |= {(int(other), number) for other in re.findall(r"\bChanged by ADR (\d+)", text)}
    assert changes == changed != set()


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
