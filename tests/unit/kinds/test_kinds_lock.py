"""A changed source below a job kind asks for a raised version, so that no stale result is reused."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sms_jobs.kinds import all_kinds

PROGRAM = Path(__file__).parents[3] / "ops" / "kinds_lock.py"


@pytest.fixture(scope="module")
def lock() -> Any:
    return SimpleNamespace(**runpy.run_path(str(PROGRAM)))


@pytest.fixture(scope="module")
def graph(lock: Any) -> Any:
    return lock.grimp.build_graph("sms_jobs")


@pytest.fixture(scope="module")
def found(lock: Any) -> Any:
    return lock.found()


def test_every_kind_is_noted_as_it_is(lock: Any, found: Any) -> None:
    assert lock.complaints(found, lock.locked()) == []
    assert lock.OFFERED.read_text("utf-8") == lock.offered()


def test_recordings_are_never_reused_and_have_no_line(found: Any) -> None:
    # A new camera or trigger box asks for no decision.
    assert found.keys() == all_kinds().keys() - {"acquire", "stream"}
    assert "simulate" in found


def test_a_digest_covers_all_that_numbers_come_from_and_no_more(lock: Any, graph: Any) -> None:
    strain = lock.sources_of("sms_jobs.kinds.deformation.strain", graph)
    assert "sms_jobs.metrology.deformation.strain.tangent_plane" in strain
    assert "sms_jobs.metrology.geometry.transforms" in strain  # two imports away
    assert not [name for name in strain if "ranging" in name or "jobs.jobs" in name]
    # What is found by its declaration is imported by nobody.
    assert "sms_jobs.formats.exporters.e57" in lock.sources_of("sms_jobs.kinds.reporting.export", graph)
    report = lock.sources_of("sms_jobs.kinds.reporting.report", graph)
    assert "sms_jobs.kinds.reporting.surface_chapter" in report


def test_code_counts_and_words_about_it_do_not(lock: Any, tmp_path: Path) -> None:
    def dumped(text: str) -> str:
        (tmp_path / "one.py").write_text(text)
        own = runpy.run_path(str(PROGRAM))
        own["_path"].__globals__["ROOT"] = tmp_path
        return str(lock.ast.dump(own["_tree"]("one")))

    plain = dumped("def f(x):\n    return 2 * x\n")
    assert dumped('"""Words."""\n\n\ndef f(x):\n    """More."""\n    return 2 * x  # and more\n') == plain
    assert dumped("def f(x):\n    return 3 * x\n") != plain


def test_a_change_is_decided_by_version_or_by_name(lock: Any) -> None:
    one, changed, raised = lock.Locked(3, "aa"), lock.Locked(3, "bb"), lock.Locked(4, "bb")
    (said,) = lock.complaints({"strain": changed}, {"strain": one})
    assert "source of strain has changed and its version, 3, has not" in said
    assert "--same-numbers strain" in said
    # Writing alone does not excuse it.
    assert lock.updated({"strain": changed}, {"strain": one}, {}) == {"strain": one}
    excused = lock.updated({"strain": changed}, {"strain": one}, {"strain": "only names"})
    assert excused == {"strain": lock.Locked(3, "bb", "only names")}
    assert lock.complaints({"strain": changed}, excused) == []
    (said,) = lock.complaints({"strain": raised}, {"strain": one})
    assert "version 4 of strain is not noted" in said
    assert lock.updated({"strain": raised}, {"strain": one}, {}) == {"strain": raised}
    (said,) = lock.complaints({}, {"strain": one})
    assert "nothing of a kind strain is reused any more" in said
