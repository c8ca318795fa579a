"""Any process may be killed or stopped: the next job begins soon, and none is lost or done twice."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack

import numpy as np

from sms_jobs.bench.figures import Condition, Figure, Found, Run
from sms_jobs.bench.promises import Promise
from sms_jobs.bench.recorded.kill_campaign import KillCampaign, Outcome, plan
from sms_jobs.bench.servers import POSTGRESQL, REDIS, fresh_postgresql

_PLACES = 4
_KILLS, _STOPS = 200, 40
_KILLS_QUICKLY, _STOPS_QUICKLY = 6, 2


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    outcomes = {"embedded": _outcome(run, "embedded", {})}
    with ExitStack() as servers:
        database, broker = servers.enter_context(fresh_postgresql()), os.environ.get(REDIS)
        if database and broker:
            urls = {"SMS_DATABASE_URL": database, "SMS_BROKER_URL": broker}
            outcomes["grown"] = _outcome(run, "grown", urls)
    for name in ("embedded", "grown"):
        survived = float(outcomes[name].kills) if name in outcomes else None
        yield Figure(f"kills_survived_{name}", survived, "kills", None if run.quick else _KILLS)
    tried = list(outcomes.values())
    yield Figure(
        "kills_survived",
        float(min(one.kills for one in tried)) if "grown" in outcomes else None,
        "kills on each deployment",
        None if run.quick else _KILLS,
    )
    yield Figure("lost", float(sum(len(one.lost) for one in tried)), "jobs", 0.0, "at most")
    yield Figure("twice", float(sum(len(one.twice) for one in tried)), "jobs", 0.0, "at most")
    yield Figure("longest_stall_s", max(max(one.stalls_s) for one in tried), "s", 30.0, "at most")
    yield Figure("idle_service_ends_s", max(one.idle_end_s for one in tried), "s", 15.0, "at most")
    jobs, stops = (sum(getattr(one, what) for one in tried) for what in ("jobs", "stops"))
    left_out = "" if "grown" in outcomes else f"; grown left out: {POSTGRESQL} and {REDIS} name no servers"
    yield Condition(
        "kills",
        f"{jobs} jobs through `sms up` with {_PLACES} processes on {' and '.join(outcomes)}, while idle and "
        f"busy processes, all at once, and the one that forks them are killed, and {stops} stopped; a stall "
        f"is the time from a hit to the next beginning of a job{left_out}",
    )


def _outcome(run: Run, name: str, environment: Mapping[str, str]) -> Outcome:
    home = run.folder / f"kills-{name}"
    home.mkdir()
    kills, stops = (_KILLS_QUICKLY, _STOPS_QUICKLY) if run.quick else (_KILLS, _STOPS)
    rng = np.random.default_rng(3)
    campaign = KillCampaign(home, environment, _PLACES, rng)
    return campaign.run(plan(kills, stops, rng), lambda said: run.say(f"kills, {name}: {said}"))


PROMISE = Promise("kills", measure)
