"""A test day: plans under kills, cameras at a rate, and its runs compared afterwards."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np

from sms_jobs.bench.compared_runs import RADIUS_PX, measured
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.recorded.killed_plan import HOLD_S, SEQUENCE, TOLERANCE, KilledPlan
from sms_jobs.bench.recorded.quick_looked import GAUGES, looked
from sms_jobs.bench.recorded.quick_looked import SIDE as LOOKED_SIDE
from sms_jobs.bench.recorded.streamed_cameras import SIDE, archived_per_cpu_s, disk_mb_s, streamed
from sms_jobs.records.measurement import FringeSequence

_STATES, _KILLS = 50, 50
_STATES_QUICKLY, _KILLS_QUICKLY = 4, 4
_COMPARED_S = 60.0
_DEMO = "the demo's bending test, 512 px, 4 views, 3 deformed states"
_RATE_HZ, _STREAM_S, _STREAM_QUICKLY_S = 60.0, 20.0, 2.0
_WANTED_HZ = 50.0
_SEALED, _SEALED_QUICKLY = 20, 3
_LOOKED, _LOOKED_QUICKLY = 3, 1
_QUICK_LOOK_S = 6.0


def measure(run: Run) -> Iterator[Found]:
    """Yield how fast cameras stream, how soon states are looked at and how many were recorded once."""
    yield from _cameras(run)
    yield from _looked(run)
    yield from _killed(run)


def _cameras(run: Run) -> Iterator[Found]:
    run.say("testday: two cameras of 1 Mpx into the spool")
    for_s = _STREAM_QUICKLY_S if run.quick else _STREAM_S
    sealed = _SEALED_QUICKLY if run.quick else _SEALED
    disk = disk_mb_s(run.folder)
    done = streamed(run.folder / "stream", _RATE_HZ, for_s)
    yield Figure("camera_rate_hz", done.rate_hz, "frames / s of each of two cameras", _WANTED_HZ)
    yield Figure("camera_frames_missed", float(done.missed), f"of {2 * round(_RATE_HZ * for_s)} frames")
    yield Figure("camera_cpu_ms", 1e3 * done.cpu_s / (2 * done.whole), "CPU-ms a frame")
    rate = archived_per_cpu_s(done.kept, run.folder / "sealed", sealed)
    yield Figure("camera_frames_archived_per_cpu_s", rate, "frames / CPU-s")
    yield Figure("camera_synced_after_s", done.synced_s, "s after the last frame")
    yield Condition(
        "camera",
        f"two cameras that hand out frames of {SIDE} x {SIDE} px in uint16 made before, exposed by software "
        f"{_RATE_HZ:g} times a second for {for_s:g} s, through ring, checksum and one write a frame to files "
        f"of the temporary folder, {4e-6 * _RATE_HZ * SIDE**2:.0f} MB/s; its disk took {disk:.0f} MB/s of "
        "one file just before, and is synced every second beside, so that what it is behind lies in the "
        "system's memory, which a killed process does not take along; the rate is of moments with a frame of "
        f"both; missed are frames that were exposed too late, and {done.refused} that had no room in memory; "
        f"archived is what comes afterwards of {sealed} states: each image judged, packed as texture and "
        f"frame, sealed and read back; load {os.getloadavg()[0]:.1f} of {os.cpu_count()} processors",
    )


def _looked(run: Run) -> Iterator[Found]:
    """Yield how soon after the last frame the gauges are read, and the conditions."""
    states = _LOOKED_QUICKLY if run.quick else _LOOKED
    done = looked(run.folder / "looked", states, lambda said: run.say(f"testday: {said}"))
    of = "s from the last frame to the gauges"
    yield Figure("quick_look_s", max(done.after_s), of, _QUICK_LOOK_S, "at most")
    read = sum(len(one.gauges) for one in done.looks)
    yield Condition(
        "quick_look",
        f"the slowest of {states} states of a plan with --next --stop-if, after the reference: one camera of "
        f"{LOOKED_SIDE} x {LOOKED_SIDE} px with one projector, both simulated, "
        f"{FringeSequence().frames} frames and white, {len(GAUGES)} gauges, of whose {states * len(GAUGES)} "
        f"values {read} came; from the time of the last frame, the white one, until the job of the quick "
        "look has succeeded in the catalogue: judging, packing, sealing and reading back of all frames is in "
        "it; `sms up` on SQLite in the temporary folder, settings as they come; load "
        f"{os.getloadavg()[0]:.1f} of {os.cpu_count()} processors",
    )


def _killed(run: Run) -> Iterator[Found]:
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


GROUP = Group(
    "testday",
    "cameras at a rate, quick looks, a plan of recordings under kills, runs compared",
    lambda: None,
    measure,
)
