"""What was not the same in two runs is told once, with whether it was asked for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from sms_jobs.jobs.asking.run_changes import alone, changes, pairs
from sms_jobs.jobs.asking.runs import Member, Members, ResultInput
from sms_jobs.records.shown.runs import RunResult

SUBJECTS = ("plate/S01/C1P1", "plate/S02/C1P1")


def member(kind: str, subject: str, job: str, **given: Any) -> Member:
    inputs = given.pop("inputs", {})
    shown = {role: f"{one.source} {one.file_id}" for role, one in inputs.items()}
    result = RunResult(kind, 3, subject, job, job, {"radius": 10}, (1,), shown, (1,))
    key = given.pop("key", "same")
    return Member(replace(result, **given), key, ("content",), ("application/x-hdf5",), inputs)


def run(*some: Member, asked: dict[str, Any] | None = None) -> Members:
    return Members(asked or {}, {(one.result.kind, one.result.subject): one for one in some}, {})


def told(before: Members, after: Members) -> list[tuple[Any, ...]]:
    return [
        (one.what, one.kind, one.name, one.before, one.after, one.results, one.intended)
        for one in changes(before, after)
    ]


def frames(number: int, job: str | None = None) -> ResultInput:
    return ResultInput(number, "measurement" if job is None else "correlate", f"content {number}", job)


def test_nothing_is_told_where_all_is_the_same() -> None:
    same = run(*(member("correlate", subject, "j") for subject in SUBJECTS))
    assert changes(same, same) == ()
    assert len(pairs(same, same)) == 2


def test_results_are_in_the_order_in_which_people_count() -> None:
    subjects = ["plate/S2/C2P1", "plate/S2/C10P1", "plate/S10/C1P1"]
    same = run(*(member("correlate", subject, "j") for subject in reversed(subjects)))
    assert [one.result.subject for one, _ in pairs(same, same)] == subjects


def test_what_was_asked_for_comes_first_and_the_rest_is_marked() -> None:
    before = run(*(member("correlate", subject, "a") for subject in SUBJECTS))
    wider = {"radius": 14, "new": 1}
    after = run(
        *(
            member("correlate", subject, "b", version=4, calibrations=(2,), parameters=wider)
            for subject in SUBJECTS
        ),
        asked={"correlate.radius": 14},
    )
    assert told(before, after) == [
        ("parameter", "correlate", "radius", 10, 14, 2, True),
        ("parameter", "correlate", "new", None, 1, 2, False),
        ("version", "correlate", "", 3, 4, 2, False),
        ("calibration", "", "", "1", "2", 2, False),
    ]


def test_a_version_is_what_is_compared_where_nothing_else_was_asked() -> None:
    before, after = (
        run(member("strain", SUBJECTS[0], "a")),
        run(member("strain", SUBJECTS[0], "b", version=4)),
    )
    assert told(before, after) == [("version", "strain", "", 3, 4, 1, True)]


def test_only_inputs_from_outside_a_run_are_told() -> None:
    moved = [
        member("correlate", SUBJECTS[0], job, inputs={"frames": frames(n)}) for job, n in (("a", 1), ("b", 2))
    ]
    strains = [
        member("strain", SUBJECTS[0], f"s{job}", inputs={"displacement": frames(n, job)})
        for job, n in (("a", 5), ("b", 6))
    ]
    whole = [run(one, other) for one, other in zip(moved, strains, strict=True)]
    found = ("input", "correlate", "frames", "measurement 1", "measurement 2", 1, False)
    assert told(*whole) == [found]
    # Without the jobs that made them, what strain was computed from came from outside.
    assert told(run(strains[0]), run(strains[1])) == [
        ("input", "strain", "displacement", "correlate 5", "correlate 6", 1, False)
    ]


def test_a_definition_is_told_where_nothing_else_explains_another_key() -> None:
    before = run(member("correlate", SUBJECTS[0], "a"))
    assert told(before, run(member("correlate", SUBJECTS[0], "b", key="other"))) == [
        ("definition", "correlate", "", None, None, 1, False)
    ]
    assert told(before, run(member("correlate", SUBJECTS[0], "b", key=None))) == []


def test_what_one_has_alone_is_counted() -> None:
    both = run(*(member("correlate", subject, "a") for subject in SUBJECTS))
    assert alone(both, run(member("correlate", SUBJECTS[0], "b"))) == {"correlate": 1}
    assert alone(run(), both) == {}


def test_of_what_is_gone_nothing_is_told_that_nobody_knows() -> None:
    there = member("correlate", SUBJECTS[0], "a", inputs={"frames": frames(1)})
    gone = member("correlate", SUBJECTS[0], "b", files=(), calibrations=(), version=4, key=None)
    assert told(run(there), run(gone)) == [("version", "correlate", "", 3, 4, 1, True)]
