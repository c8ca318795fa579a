"""`sms bench` and `sms study` as a person runs them."""

from __future__ import annotations

import os

import pytest
from support.command import answer, inside

from sms_jobs.bench.command import bench
from sms_jobs.errors import InvalidInput


def test_bench_prints_one_object_for_programs() -> None:
    found = answer("bench", "--quick", "phase")
    assert found["schema"] == 1
    assert found["quick"] is True
    assert found["results"].keys() == {"phase.reverse_exponential_mpx_frames_per_cpu_s"}
    assert found["results"]["phase.reverse_exponential_mpx_frames_per_cpu_s"] > 0.0
    assert found["compile_s"] > 0.0
    assert found["machine"]["cores"] >= 1
    assert "one thread" in found["conditions"]["phase.reverse_exponential"]


def test_what_does_not_exist_is_refused_before_anything_is_measured() -> None:
    for command, words in (("bench", "no benchmark 'speed'"), ("study", "no study 'speed'")):
        done = inside(command, "speed")
        assert done.returncode == 2
        assert words in done.stderr
        assert done.stdout == ""


def test_studies_are_listed() -> None:
    assert {"table-6", "ranging-bound", "two-returns", "plate-mirror"} <= answer("study", "list")[
        "studies"
    ].keys()
    assert "Table 6" in inside("study", "list").stdout


def test_a_bench_has_one_thread_of_linear_algebra_as_a_worker_has(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    for name in names:
        monkeypatch.setenv(name, "7")
    with pytest.raises(InvalidInput):
        bench(["nothing"])
    assert [os.environ[name] for name in names] == ["1"] * 3
