"""Figures and groups: found by themselves, honest about targets, complete for programs."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from sms_jobs.bench.figures import Condition, Figure, Run, cpu_seconds, machine
from sms_jobs.bench.groups import all_groups, group_named, phase
from sms_jobs.errors import InvalidInput


def test_groups_are_found_by_themselves() -> None:
    assert {"phase", "fdr"} <= all_groups().keys()
    assert all(group.name == name for name, group in all_groups().items())
    with pytest.raises(InvalidInput, match="no benchmark 'speed'; choose one of"):
        group_named("speed")


@pytest.mark.parametrize(
    ("figure", "met"),
    [
        (Figure("a", 3.0, "1", 3.0), True),
        (Figure("a", 2.9, "1", 3.0), False),
        (Figure("a", 2.9, "1", 3.0, "at most"), True),
        (Figure("a", 3.1, "1", 3.0, "at most"), False),
        (Figure("a", 3.1, "1"), None),
        (Figure("a", None, "1", 3.0), None),
    ],
)
def test_a_target_is_met_on_its_side(figure: Figure, met: bool | None) -> None:
    assert figure.met is met


def test_time_is_that_of_repeated_calls_after_one_that_does_not_count() -> None:
    calls: list[int] = []
    taken = cpu_seconds(lambda: calls.append(sum(range(20_000))), repeats=3)
    assert len(calls) == 4
    assert taken > 0.0


def test_the_machine_is_described() -> None:
    about = machine()
    assert about["cores"]
    assert float(about["memory_gb"]) > 0.1
    assert {"processor", "python", "numba", "load_before"} <= about.keys()


def test_the_phase_group_yields_its_figure_and_says_its_conditions(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    said: list[str] = []
    say: Callable[[str], None] = said.append
    found = list(phase.measure(Run(True, say, 1, tmp_path_factory.mktemp("bench"))))
    figures = {f.name: f for f in found if isinstance(f, Figure)}
    assert figures["reverse_exponential_mpx_frames_per_cpu_s"].value
    assert any(isinstance(one, Condition) and "1024 x 128 px" in one.text for one in found)
