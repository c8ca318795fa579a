"""What is compiled before jobs want it: the list names kernels, and each is compiled once, callees first."""

import inspect
import json
import logging
import os
import subprocess
import sys
import textwrap

import pytest
import typer
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.app.work.kernels import kernels_left
from sms_jobs.cli.doctor import doctor
from sms_jobs.jobs.running import kernels
from sms_jobs.jobs.running.kernels import Kernel
from sms_jobs.metrology.kernel_cache import KernelCache
from sms_jobs.metrology.signatures import text_of

_KERNELS = textwrap.dedent(
    """
    from sms_jobs.metrology.compilation import kernel

    @kernel
    def first(x):
        return x + 1.0

    @kernel
    def second(x):
        return first(x) * 2.0

    @kernel
    def third(x):
        return second(x) + first(x)

    @kernel
    def impossible(x):
        return x.nothing
    """
)


@pytest.fixture
def some(tmp_path, monkeypatch):
    (tmp_path / "kernels_to_prepare.py").write_text(_KERNELS)
    monkeypatch.syspath_prepend(tmp_path)
    yield [Kernel(f"kernels_to_prepare:{name}", "(float64,)") for name in ("third", "second", "first")]
    sys.modules.pop("kernels_to_prepare", None)


def test_the_list_names_kernels_and_types():
    for one in kernels.listed():
        assert one.dispatcher.py_func.__name__ in one.name or "lens" in one.name, one.name
        assert text_of(one.types) == one.signature, one.name
        takes = len(inspect.signature(one.dispatcher.py_func).parameters)
        assert len(one.types) == takes, f"{one.name} takes {takes} arguments: write the list again"


def test_the_list_names_what_is_called_by_what_it_names():
    listed = {id(one.dispatcher) for one in kernels.listed()}
    for one in kernels.listed():
        for called in kernels._called(one.dispatcher.py_func):
            assert id(called) in listed or not isinstance(called._cache, KernelCache), (one.name, called)


def test_the_list_names_nothing_twice():
    assert len(set(kernels.listed())) == len(kernels.listed())


@pytest.mark.parametrize("processes", [1, 3])
def test_each_is_compiled_once_and_after_what_it_calls(some, processes):
    assert kernels.missing(some) == some
    assert max(kernels.compile_all(some, processes)) == 3
    assert kernels.missing(some) == []
    caches = [one.dispatcher._cache for one in some]
    assert [len(cache.compilations()) for cache in caches] == [1, 1, 1]
    assert list(kernels.compile_all(some, processes)) == []
    calls = kernels._callees(some)
    assert calls["kernels_to_prepare:third"] == {"kernels_to_prepare:second", "kernels_to_prepare:first"}
    assert calls["kernels_to_prepare:first"] == frozenset()


@pytest.mark.parametrize(
    ("name", "signature", "words"),
    [("impossible", "(float64,)", ""), ("first", "(float64, float64)", "Signature mismatch")],
)
def test_what_cannot_be_compiled_keeps_nothing_else(some, caplog, name, signature, words):
    wrong = Kernel(f"kernels_to_prepare:{name}", signature)
    with caplog.at_level(logging.WARNING):
        list(kernels.compile_all([wrong, *some], 1))
    assert kernels.missing([wrong, *some]) == [wrong]
    assert f"kernels_to_prepare:{name} {signature} cannot be compiled: {words}" in caplog.text


def test_a_kernel_that_is_gone_is_told(some):
    with pytest.raises(kernels.SmsError, match=r"there is no kernel 'kernels_to_prepare:gone'.*ops/kernels"):
        _ = Kernel("kernels_to_prepare:gone", "(float64,)").dispatcher


_SERVICE = textwrap.dedent(
    """
    import os, sys
    from pathlib import Path
    from sms_jobs.jobs.running import kernels
    kernels.LIST = Path("list.txt")
    from sms_jobs.workers import preparation
    lifeline, _ = os.pipe()
    preparation.start(lifeline, sys.stdin.fileno())
    _, status = os.wait()
    sys.exit(os.waitstatus_to_exitcode(status))
    """
)


def test_a_service_compiles_what_is_missing_and_nothing_again(some, tmp_path):
    home = tmp_path / "home"
    initialised(home)
    (tmp_path / "list.txt").write_text("".join(f"{one.name} {one.signature}\n" for one in some))
    places = {"SMS_HOME": str(home), "SMS_WORKERS": "2", "PYTHONPATH": str(tmp_path)}
    said = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", _SERVICE],
            cwd=tmp_path,
            env=os.environ | places,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        said.append(done.stderr)
    assert "compiling 3 kernels" in said[0]
    assert "all kernels are compiled" in said[0]
    assert "kernels" not in said[1]
    assert [len(one.dispatcher._cache.compilations()) for one in some] == [1, 1, 1]
    assert not list(home.glob("logs/kernels*"))


def test_how_many_are_left_is_told_while_they_are_compiled(tmp_path):
    initialised(tmp_path)
    with bootstrap.services(tmp_path) as services:
        assert kernels_left(services) == 0
        services.settings.kernels_left_file.parent.mkdir(exist_ok=True)
        services.settings.kernels_left_file.write_text("17\n")
        assert kernels_left(services) == 17


def test_the_doctor_compiles_what_is_missing_and_tells_what_it_took(some, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(kernels, "listed", lambda: tuple(some))
    doctor(kernels=True, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert told["compiled"] == 3
    assert [one["state"] for one in told["kernels"]] == ["ready"] * 3
    assert told["compile_cpu_s"] == pytest.approx(sum(one["compile_cpu_s"] for one in told["kernels"]))
    doctor(kernels=True, as_json=False)
    assert "kernels_to_prepare:third" in capsys.readouterr().out
    monkeypatch.setattr(kernels, "listed", lambda: (Kernel("kernels_to_prepare:impossible", "(float64,)"),))
    with pytest.raises(typer.Exit) as end:
        doctor(kernels=True, as_json=True)
    assert end.value.exit_code == 6
