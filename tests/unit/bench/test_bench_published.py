"""The thesis's numbers: counted once, each with a study or a reason, and judged by their sense."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sms_jobs.bench.figures import Condition, Figure, Run
from sms_jobs.bench.groups import thesis
from sms_jobs.bench.published import COLUMNS, PUBLISHED, Judged, in_chapters
from sms_jobs.bench.studies import all_studies


def test_every_number_has_a_study_or_a_reason() -> None:
    for key, one in PUBLISHED.items():
        assert re.fullmatch(r"[a-z0-9. -]+", key), key
        assert bool(one.study) != bool(one.why_not), key
        if one.study:
            assert one.study in all_studies(), key
            assert one.value is not None, key
            assert (one.sense == "near") == (one.tolerance > 0.0 or "regions" in key), key


def test_numbers_stand_in_their_chapters() -> None:
    assert {key: PUBLISHED[key].chapter for key in ("motion-largest", "hat-pairs", "wing-524-1")} == {
        "motion-largest": 4, "hat-pairs": 5, "wing-524-1": 6,
    }  # fmt: skip
    assert PUBLISHED["buckling-calibration"].chapter == 6
    assert PUBLISHED["table-6-original-mean"].chapter == PUBLISHED["peak-1"].chapter == 7
    assert len(in_chapters(5, 7)) + len(in_chapters(4, 4)) == len(PUBLISHED)
    # Nine loads of two gauges that can be read, and of a third whose columns cannot.
    assert sum(one.place == "Table 5" for one in PUBLISHED.values()) == 9 * 5 + 5


@pytest.mark.parametrize(
    ("judged", "verdict"),
    [
        (Judged("motion-largest", 0.1), "met"),
        (Judged("motion-largest", 0.11), "missed"),
        (Judged("motion-largest", float("nan")), "not measured"),
        (Judged("plate-better", 14.0), "met"),
        (Judged("plate-better", 4.9), "missed"),
        (Judged("wing-1955-1", 1700.0, 1612.0, 40.0), "met"),
        (Judged("wing-1955-1", 1713.0, 1612.0, 40.0), "missed"),
        (Judged("buckling-regions", 19.0, 19.0), "met"),
        (Judged("buckling-regions", 18.0, 19.0), "missed"),
    ],
)
def test_a_verdict_follows_from_the_sense(judged: Judged, verdict: str) -> None:
    assert judged.verdict == verdict
    assert len(judged.row()) == len(COLUMNS)


def test_z_is_of_what_has_a_truth_and_a_deviation() -> None:
    assert Judged("wing-1955-1", 1700.0, 1612.0, 40.0).z == pytest.approx(2.2)
    assert Judged("wing-1955-1", 1700.0, 1612.0).z is None
    assert Judged("motion-largest", 0.1).z is None


def test_numbers_with_a_verdict_are_counted_and_what_is_missed_is_named() -> None:
    judged = [
        Judged("motion-largest", 0.2),
        Judged("hat-pairs", 0.05),
        Judged("plate-better", 3.0),
        Judged("wing-1955-1", float("nan"), 1612.0),
    ]
    found = list(thesis.counted(judged))
    figures = {one.name: one for one in found if isinstance(one, Figure)}
    # Section 4.6 is not of chapters 5 to 7, and what was not measured has no verdict.
    assert (figures["rows"].value, figures["met"].value) == (2.0, 1.0)
    assert f"of {len(in_chapters(5, 7))} published" in figures["rows"].unit
    told = {one.topic: one.text for one in found if isinstance(one, Condition)}
    assert "Fig. 53, mean displacement, largest error, mm; Fig. 111, lit twice" in told["met"]
    assert "lost in the text at hand" in told["rows"]


def test_a_quick_run_leaves_the_studies_out(tmp_path: Path) -> None:
    figure, condition = thesis.measure(Run(True, print, 1, tmp_path))
    assert isinstance(figure, Figure)
    assert figure.value is None
    assert isinstance(condition, Condition)
