"""What is compiled before jobs want it: the list names kernels, and each is compiled once, callees first."""

import logging
import sys
import textwrap

import pytest

from sms_jobs.jobs import kernels
from sms_jobs.jobs.kernels import Kernel
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


@pytest.mark.parametrize("one", kernels.listed(), ids=lambda one: one.name)
def test_the_list_names_kernels_and_types(one):
    assert one.dispatcher.py_func.__name__ in one.name or "lens" in one.name
    assert text_of(one.types) == one.signature


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


def test_what_cannot_be_compiled_keeps_nothing_else(some, caplog):
    impossible = Kernel("kernels_to_prepare:impossible", "(float64,)")
    with caplog.at_level(logging.WARNING):
        list(kernels.compile_all([impossible, *some], 1))
    assert kernels.missing([impossible, *some]) == [impossible]
    assert "kernels_to_prepare:impossible (float64,) cannot be compiled" in caplog.text


def test_a_kernel_that_is_gone_is_told(some):
    with pytest.raises(kernels.SmsError, match=r"there is no kernel 'kernels_to_prepare:gone'.*ops/kernels"):
        _ = Kernel("kernels_to_prepare:gone", "(float64,)").dispatcher
