"""A test day: what is planned is recorded once, whoever is killed; and its runs are compared afterwards."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sms_jobs.bench.compared_runs import RADIUS_PX, measured
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.killed_plan import HOLD_S, SEQUENCE, TOLERANCE, KilledPlan

_STATES, _KILLS = 50, 50
_STATES_QUICKLY, _KILLS_QUICKLY = 4, 4
_COMPARED_S = 60.0
_DEMO = "the demo's bending test, 512 px, 4 views, 3 deformed states"


def measure(run: Run) -> Iterator[Found]:
    """Yield how many states were recorded once, which frames were lost, and the conditions."""
    states, kills = (_STATES_QUICKLY, _KILLS_QUICKLY) if run.quick else (_STATES, _KILLS)
    home = run.folder / "testday"
    home.mkdir()
    killed = KilledPlan(home, {}, states, np.random.default_rng(11))
    day = killed.run(kills, lambda said: run.say(f"testday: {said}"))
    yield Figure("states_recorded_once", float(day.once), f"of {states} states", float(states))
    yield Figure("states_off_their_load", float(day.doubted), "states", 0.0, "at most")
    yield Figure("frames_lost", float(day.lost), f"of {day.delivered} frames", 0.0, "at most")
    yield Condition(
        "testday",
        f"{states} states planned with --on load_n --tolerance {TOLERANCE} --hold {HOLD_S:g}s, on SQLite "
        "with one process for jobs, a simulated rig of one camera and one projector, "
        f"{SEQUENCE.frames} frames a state, and a load frame that ramps and holds; {day.kills} kills "
        "by SIGKILL of the supervisor, of its processes, or of both, most of them within 3 s of the "
        "beginning of a recording, each followed by another start; "
        f"{day.resumed} recordings broke off and were resumed as "
        "`sms acquire resume` does, in place of an operator; frames are those of complete sets and all that "
        "lay whole in the spool after a kill",
    )
    yield from _compared(run)


def _compared(run: Run) -> Iterator[Found]:
    """Yield what comparing two runs takes, and the conditions."""
    taken = measured(run.folder / "runs", run.quick, lambda said: run.say(f"testday: {said}"))
    yield Figure("compare_runs_s", taken.cpu_s, "s of one thread", _COMPARED_S, "at most")
    of = "the small plate, 128 px, 2 views, 1 deformed state" if run.quick else _DEMO
    yield Condition(
        "compare_runs",
        f"sms run compare with -o page.html, of two runs of {of}, subsets of radius 10 and {RADIUS_PX} px: "
        f"{taken.quantities} quantities of displacement and strain, {taken.pixels / 1e6:.3g} million "
        f"differences of pixels, a page of {taken.page_mb:.1f} MB; CPU time of the command from its start "
        "to its end, files in the system's cache",
    )


GROUP = Group("testday", "a plan of recordings under kills", lambda: None, measure)
