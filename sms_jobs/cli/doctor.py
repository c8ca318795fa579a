"""`sms doctor`: what is wrong with a home, and what to do about it."""

from __future__ import annotations

from typing import Annotated

import typer

from sms_jobs.app.home.doctor import Examined, diagnosed
from sms_jobs.app.work import kernels as kernels_
from sms_jobs.cli import bars, output
from sms_jobs.cli.output import Home, Json

_FINDINGS = 6


def doctor(
    kernels: Annotated[
        bool,
        typer.Option(
            "--kernels", help="Compile what jobs need on this machine, and show what it took; nothing else."
        ),
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Check catalogue, archive, messages, workers, clock and disk; say what to do about each finding.

    Example: sms doctor
    """
    if kernels:
        _prepare_kernels(as_json)
        return
    with diagnosed(home) as found:
        checks = [one for name, examined in found.items() for one in _rows(name, examined)]
    bad = any(finding for _, finding, _ in checks)
    if as_json:
        shown = [{"check": name, "finding": finding or "ok", "found": what} for name, finding, what in checks]
        output.print_json({"healthy": not bad, "checks": shown})
    else:
        rows = [(name, finding or f"ok{what and ': '}{what}") for name, finding, what in checks]
        output.print_table(["check", "finding"], rows, empty="")
    if bad:
        raise typer.Exit(_FINDINGS)


def _rows(name: str, examined: Examined) -> list[tuple[str, str, str]]:
    return [(name, finding, examined.what) for finding in examined.findings or ("",)]


def _prepare_kernels(as_json: bool) -> None:
    missing = kernels_.compile_missing()
    total = next(missing, 0)  # which forks processes, as long as there are no threads
    if total:
        with bars.job_bar() as bar:
            task = bar.add_task("compiling kernels", total=total, pace="")
            for left in missing:
                bar.update(task, completed=total - left)
    states = kernels_.states()
    took = sum(one.compile_cpu_s or 0.0 for one in states)
    if as_json:
        shown = [
            {
                "kernel": one.name,
                "signature": one.signature,
                "state": _state(one),
                "compile_cpu_s": one.compile_cpu_s,
            }
            for one in states
        ]
        output.print_json({"kernels": shown, "compiled": total, "compile_cpu_s": took})
    else:
        states.sort(key=lambda one: -(one.compile_cpu_s or 0.0))
        rows = [(one.name, one.signature, _state(one), _seconds(one.compile_cpu_s)) for one in states]
        output.print_table(["kernel", "signature", "state", "CPU-s"], rows, empty="")
        output.print_facts({"kernels": len(states), "compiled now": total, "all of them took, CPU-s": took})
    if not all(one.ready for one in states):
        raise typer.Exit(_FINDINGS)


def _state(one: kernels_.KernelState) -> str:
    return "ready" if one.ready else "missing"


def _seconds(cpu_s: float | None) -> str:
    return "" if cpu_s is None else f"{cpu_s:.2f}"
