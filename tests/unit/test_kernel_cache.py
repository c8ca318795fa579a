"""No kernel is compiled twice on one machine, and nobody waits for one who is gone."""

import os
import subprocess
import sys
import textwrap
import time
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
from numba.core.errors import TypingError

from sms_jobs.metrology import kernel_cache
from sms_jobs.metrology.compilation import kernel
from sms_jobs.metrology.kernel_cache import KernelCache

_KERNELS = textwrap.dedent(
    """
    from sms_jobs.metrology.compilation import kernel

    @kernel
    def squared(x):
        return x * x

    @kernel
    def summed(values):
        total = 0.0
        for value in values:
            total += squared(value)
        return total
    """
)
_CALLER = textwrap.dedent(
    """
    import sys, time
    from pathlib import Path
    import numpy as np
    import kernels_of_test
    sys.stdout.write("here\\n")
    sys.stdout.flush()
    while not Path("go").exists():
        time.sleep(0.001)
    kind = np.float64 if int(sys.argv[1]) % 2 else np.float32
    assert kernels_of_test.summed(np.full(3, 2.0, kind)) == 12.0
    """
)


@pytest.fixture
def place(tmp_path):
    (tmp_path / "kernels_of_test.py").write_text(_KERNELS)
    return tmp_path


@contextmanager
def _started(place, script, *arguments):
    process = subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        cwd=place,
        env={name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"},
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        try:
            assert process.stdout.readline() == "here\n"
            yield process
        finally:
            process.kill()


def _signatures(place):
    """Every compilation that was noted, of whatever kernel, as `kernel signature`."""
    notes = (place / "__pycache__").glob("*.lock")
    return sorted(
        " ".join([note.name.split("-")[0], line.split("\t")[2]])
        for note in notes
        for line in note.read_text().splitlines()
    )


def test_processes_that_start_at_once_compile_each_kernel_once(place):
    with ExitStack() as stack:
        callers = [stack.enter_context(_started(place, _CALLER, str(n))) for n in range(4)]
        (place / "go").touch()
        assert [caller.wait() for caller in callers] == [0] * 4
    assert _signatures(place) == [
        "kernels_of_test.squared (float32,)",
        "kernels_of_test.squared (float64,)",
        "kernels_of_test.summed (float32[::1],)",
        "kernels_of_test.summed (float64[::1],)",
    ]
    # Both signatures are in the index of each: who comes later compiles nothing.
    for n in range(2):
        with _started(place, _CALLER, str(n)) as caller:
            assert caller.wait() == 0
    assert len(_signatures(place)) == 4


_HOLDER = textwrap.dedent(
    """
    import sys, time
    import kernels_of_test
    assert kernels_of_test.summed._cache.take_turn()
    sys.stdout.write("here\\n")
    sys.stdout.flush()
    time.sleep(600)
    """
)


def test_a_compiler_that_is_killed_keeps_nobody(place):
    (place / "go").touch()
    with _started(place, _HOLDER) as holder, _started(place, _CALLER, "1") as waiting:
        with pytest.raises(subprocess.TimeoutExpired):
            waiting.wait(2.0)
        assert _signatures(place) == []
        holder.kill()
        assert waiting.wait() == 0
    assert len(_signatures(place)) == 2


def test_a_compiler_that_hangs_keeps_nobody_for_ever(place, monkeypatch):
    monkeypatch.syspath_prepend(place)
    monkeypatch.setattr(kernel_cache, "_PATIENCE_S", 0.1)
    with _started(place, _HOLDER):
        import kernels_of_test

        assert not kernels_of_test.summed._cache.take_turn(wait=False)
        assert kernels_of_test.summed(np.ones(2)) == 2.0
    del sys.modules["kernels_of_test"]


def test_a_kernel_that_cannot_be_compiled_gives_its_turn_away():
    @kernel
    def impossible(x):
        return x.nothing

    with pytest.raises(TypingError):
        impossible(1.0)
    assert impossible._cache._turns == 0
    assert impossible._cache._descriptor == -1


def test_kernels_work_where_nothing_can_be_written(monkeypatch):
    def refuse(*arguments, **named):
        raise OSError(28, "no room")

    @kernel
    def doubled(x):
        return 2.0 * x

    monkeypatch.setattr(os, "open", refuse)
    monkeypatch.setattr(KernelCache, "_save_overload", refuse)
    assert doubled(2.0) == 4.0
    assert doubled._cache.compilations() == []


def test_kernels_work_without_a_folder(monkeypatch):
    monkeypatch.setattr(kernel_cache.KernelCache._impl_class, "_locator_classes", [])

    @kernel
    def halved(x):
        return 0.5 * x

    assert not isinstance(halved._cache, KernelCache)
    assert halved(2.0) == 1.0


def test_time_of_a_callee_is_not_that_of_its_caller(place, monkeypatch):
    monkeypatch.syspath_prepend(place)
    import kernels_of_test

    began = time.thread_time()
    kernels_of_test.summed(np.ones(2))
    taken = time.thread_time() - began
    try:
        noted = [
            one.cpu_s
            for used in (kernels_of_test.squared, kernels_of_test.summed)
            for one in used._cache.compilations()
        ]
    finally:
        del sys.modules["kernels_of_test"]
    assert len(noted) == 2
    assert all(cpu_s > 0.0 for cpu_s in noted)
    assert sum(noted) <= taken


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(tmp_path):
    package = tmp_path / "package_of_test"
    package.mkdir()
    (package / "__init__.py").write_text("")
    top = "from sms_jobs.metrology.compilation import kernel\n"
    top_of_caller = f"{top}from package_of_test.callee import scaled\n"
    (package / "caller.py").write_text(
        f"{top_of_caller}@kernel\ndef called(x):\n    return scaled(x) + 1.0\n"
    )
    script = "from package_of_test.caller import called; print(called(2.0))"

    def answer(factor):
        (package / "callee.py").write_text(f"{top}@kernel\ndef scaled(x):\n    return {factor} * x\n")
        command = [sys.executable, "-B", "-c", script]
        return subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True).stdout

    assert [answer("2.0"), answer("2.0"), answer("3.0")] == ["5.0\n", "5.0\n", "7.0\n"]
