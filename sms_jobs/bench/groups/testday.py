"""A test day: what is planned is recorded once, whenever the service is killed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.killed_plan import HOLD_S, SEQUENCE, TOLERANCE, KilledPlan

_STATES, _KILLS = 50, 50
_STATES_QUICKLY, _KILLS_QUICKLY = 4, 4


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


GROUP = Group("testday", "a plan of recordings under kills", lambda: None, measure)
