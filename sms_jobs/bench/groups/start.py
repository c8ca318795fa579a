"""The first minutes: what commands take beside bare imports, and what compiling adds to the first demo."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import median

from sms_jobs import bootstrap
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.whole_runs import Taken, taken_by

_ROUNDS = 9


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    yield from _commands(run)
    yield from _first_run(run)


def _commands(run: Run) -> Iterator[Found]:
    home = run.folder / "home"
    bootstrap.initialise(home)
    bare = [sys.executable, "-P", "-c", "import sqlalchemy, typer"]
    sms = str(Path(sys.executable).with_name("sms"))
    for words in ("status", "job list", "campaign list", "data find"):
        ratios = []
        for _ in range(_ROUNDS):
            ours = taken_by([sms, *words.split(), "--home", str(home)], os.environ)
            ratios.append(ours.cpu_s / taken_by(bare, os.environ).cpu_s)
        target = 1.5 if words == "status" else None
        yield Figure(f"{words.replace(' ', '_')}_over_bare", median(ratios), "", target, "at most")
    yield Condition(
        "over_bare",
        f"CPU time of 'sms status' and others, in a new home on SQLite, over that of 'python -c \"import "
        f"sqlalchemy, typer\"'; median of {_ROUNDS} rounds in turn",
    )


def _first_run(run: Run) -> Iterator[Found]:
    share, slower, twice = "compile_cpu_s_over_demo_cpu_s", "cold_over_warm", "compiled_again"
    if run.quick:
        yield Figure("demo_cpu_s", None, "CPU-s")
        yield Figure("compile_cpu_s", None, "CPU-s")
        yield Figure(share, None, "", 0.25, "at most")
        yield Figure(slower, None, "", 1.3, "at most")
        yield Figure(twice, None, "", 0.0, "at most")
        yield Condition("first_run", "left out with --quick: it takes the demo twice")
        return
    kernels = run.folder / "kernels"
    run.say("start: the demo with no kernel compiled")
    cold = _demo(run.folder / "cold", kernels)
    compiled = _compilations(kernels)
    compile_cpu_s = sum(sum(seconds) for seconds in compiled.values())
    run.say("start: the demo again, elsewhere, with these kernels")
    warm = _demo(run.folder / "warm", kernels)
    again = sum(map(len, _compilations(kernels).values())) - len(compiled)
    yield Figure("demo_cpu_s", warm.cpu_s, "CPU-s")
    yield Figure("compile_cpu_s", compile_cpu_s, "CPU-s")
    yield Figure(share, compile_cpu_s / warm.cpu_s, "", 0.25, "at most")
    yield Figure(slower, cold.wall_s / warm.wall_s, "", 1.3, "at most")
    yield Figure(twice, float(again), "", 0.0, "at most")
    yield Condition(
        "first_run",
        f"'sms demo' in a new home, {os.cpu_count()} places, each run by itself: {_told(cold)} with an empty "
        f"cache of kernels and {_told(warm)} with a full one, all processes counted; {len(compiled)} kernels "
        f"were compiled in {compile_cpu_s:.0f} CPU-s; what any process compiled a second time, or the second "
        "demo at all, is counted as 'compiled again'",
    )


def _demo(home: Path, kernels: Path) -> Taken:
    """Run the demo in a new home with kernels of that folder."""
    command = [sys.executable, "-P", "-m", "sms_jobs.cli.main", "demo", "--json", "--out", str(home)]
    return taken_by(command, os.environ | {"NUMBA_CACHE_DIR": str(kernels)})


def _compilations(kernels: Path) -> dict[str, list[float]]:
    """Return the CPU-seconds of every compilation into a folder, by kernel and types of its arguments."""
    found: dict[str, list[float]] = {}
    for file in kernels.rglob("*.lock"):
        for line in file.read_text("utf-8").splitlines():
            _, seconds, signature = line.split("\t")
            found.setdefault(f"{file.relative_to(kernels)} {signature}", []).append(float(seconds))
    return found


def _told(taken: Taken) -> str:
    return f"{taken.wall_s:.0f} s and {taken.cpu_s:.0f} CPU-s"


GROUP = Group(
    "start",
    "what commands take beside bare imports, and the first demo beside later ones",
    lambda: None,
    measure,
)
