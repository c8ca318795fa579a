"""The commands that a report names make the same results again, and what speaks against them is said."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from html import unescape
from typing import Any

import numpy as np

from sms_jobs.cli.kind_options import given_parameters, split_words
from sms_jobs.formats.report.certificate import calibration_summary, doubts, doubts_of, recordings
from sms_jobs.formats.report.origins import commands, origins
from sms_jobs.kinds import kind_named
from sms_jobs.records.recording import Recording, Verdict
from sms_jobs.records.subject import Subject
from sms_jobs.records.times import UNTIMED
from sms_jobs.virtual_rig.campaigns import top_hat_bending


@dataclass(frozen=True)
class Made:
    kind: str
    subject: Subject
    parameters: dict[str, Any] = field(default_factory=dict)
    kind_version: int = 2
    created_at: datetime = datetime(2026, 1, 2, tzinfo=UTC)
    program_version: str = "0.1"
    host: str = "<host>"
    operator: str = "me"


@dataclass(frozen=True)
class File:
    provenance: Made
    path: str = "wing/S01/x.h5"
    content_hash: str = "ab" * 32


def made(kind: str, state: str, view: str, **given: Any) -> File:
    parameters = kind_named(kind).parameters(**given).model_dump(mode="json")
    return File(Made(kind, Subject("wing", state, view), parameters))


def listed(*files: Any) -> tuple[list[str], str]:
    kinds = {file.provenance.kind for file in files if isinstance(file, File)} - {"import"}
    defaults = {kind: kind_named(kind).parameters().model_dump(mode="json") for kind in kinds}
    html = "".join(part.html for part in commands(files, "wing", defaults))
    return [unescape(found) for found in re.findall(r"<code>(sms [^<]*)</code>", html)], html


def test_a_command_says_what_differs_from_the_defaults_alone() -> None:
    (plain,), _ = listed(made("strain", "S01", "C1P1"), made("strain", "S02", "C1P1"))
    assert plain == "sms job submit strain -c wing"


def test_a_command_gives_the_parameters_back() -> None:
    changed = {"mm_per_px": 0.05, "outline": "none"}
    (line,), _ = listed(made("plane", "S01", "C1", **changed))
    words = shlex.split(line)
    assert words[:6] == ["sms", "job", "submit", "plane", "-c", "wing"]
    kinds, settings = split_words(["plane", *words[6:]])
    again = kind_named(*kinds).parameters(**given_parameters(settings))
    assert again == kind_named("plane").parameters(**changed)


def test_results_made_in_two_ways_have_two_commands_with_their_states() -> None:
    found, _ = listed(
        made("strain", "S01", "C1P1"),
        made("strain", "S02", "C1P1", gauge_length_mm=30.0),
        made("strain", "S02", "C1P2", gauge_length_mm=30.0),
    )
    assert found == [
        "sms job submit strain -c wing --state S01 --view C1P1",
        "sms job submit strain -c wing --state S02 --view C1P1 --view C1P2 --gauge-length-mm 30.0",
    ]


def test_what_was_recorded_cannot_be_computed() -> None:
    found, html = listed(File(Made("import", Subject("wing", "S01", "C1P1"))), "no file")
    assert found == []
    assert "recorded or imported" in html


def test_every_file_is_named_with_what_made_it() -> None:
    (table,) = origins({"<role>": made("strain", "S01", "C1P1"), "bare": object()})
    for words in ("&lt;role&gt;", "strain, version 2", "wing/S01/x.h5", "ab" * 8, "&lt;host&gt;", "bare"):
        assert words in table.html


def recording(*said: str) -> Recording:
    verdict = Verdict(0.8, 0.001, 0.3, said)
    return Recording("hall", verdict, 1, 2, numbers=np.arange(3), times_s=np.arange(3.0))


def test_doubts_are_told_and_escaped() -> None:
    found = {"wing/S01/C1P1": recording("<dim>"), "wing/S02/C1P1": recording()}
    said = tuple(doubts_of(None, found))
    assert said == ("Recording wing/S01/C1P1: <dim>",)
    (box,) = doubts(said)
    assert "&lt;dim&gt;" in box.html
    assert doubts(()) == []
    (table,) = recordings(found)
    assert table.html.count("<tr>") == 3


def test_a_calibration_without_a_record_of_its_quality_says_so() -> None:
    calibration, _ = top_hat_bending("page", "small")
    html = "".join(part.html for part in calibration_summary(calibration, None))
    assert calibration.origin in html
    assert "Nothing is known of its uncertainty" in html


def test_since_when_a_calibration_is_valid_is_told_where_anybody_knows() -> None:
    calibration, _ = top_hat_bending("page", "small")

    def page(moment: datetime) -> str:
        parts = calibration_summary(replace(calibration, valid_from=moment), None)
        return "".join(part.html for part in parts)

    assert "2026-03-01" in page(datetime(2026, 3, 1, 12, tzinfo=UTC))
    untimed = page(UNTIMED)
    assert "not known" in untimed
    assert str(UNTIMED.year) not in untimed
