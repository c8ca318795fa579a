"""Two named runs of the demo's bending test, and what comparing them takes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from sms_jobs import bootstrap
from sms_jobs.app.work import jobs, new_jobs
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.bench.tampering import runner
from sms_jobs.errors import SmsError
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.running import recovery
from sms_jobs.virtual_rig.campaigns import small_plate, top_hat_bending

CAMPAIGN = "bending"
RADIUS_PX = 14
_BEFORE, _AFTER = "today", "wider"
_KINDS = ("reconstruct", "correlate", "strain")


@dataclass(frozen=True)
class ComparedRuns:
    """What it took.

    Attributes
    ----------
    cpu_s
        Of the command, with all that it loads, a page of maps included.
    page_mb
        Size of that page.
    quantities
        How many rows the table has.
    pixels
        How many differences of pixels are in it.
    """

    cpu_s: float
    page_mb: float
    quantities: int
    pixels: int


def measured(home: Path, quick: bool, say: Callable[[str], None]) -> ComparedRuns:
    """Compute a campaign twice, with subsets of two sizes, and let the command compare the runs.

    Parameters
    ----------
    home
        A folder for a home.
    quick
        With the small plate in place of the demo's campaign.

    Raises
    ------
    SmsError
        A job, or the command, did not succeed.
    """
    bootstrap.initialise(home)
    calibration, campaign = small_plate(CAMPAIGN) if quick else top_hat_bending(CAMPAIGN, "small")
    with bootstrap.services(home) as services:
        now = datetime.now(UTC)
        register_campaign(services.catalogue, services.archive, campaign, calibration, now)
        with services.catalogue.writing() as session:
            recovery.register_worker(session, "bench", "bench", 1, ["cpu", "acquisition"], 1, now)
        wider = {"correlate.subset_radius_px": RADIUS_PX}
        for run, kinds, parameters in (
            (_BEFORE, ("simulate", *_KINDS), {}),
            (_AFTER, _KINDS, wider),
        ):
            say(f"computing run {run} of {len(campaign.states)} states and {len(campaign.views)} views")
            done = new_jobs.submit(services, Work(CAMPAIGN, kinds, parameters, run=run))
            runner(home, services.catalogue, services.archive).run_queued()
            failed = [one for one in jobs.list_jobs(services, limit=len(done.job_ids)) if one.error]
            if failed:
                raise SmsError(f"{len(failed)} jobs of run {run} did not succeed: {failed[0].error}")
    page = home / "page.html"
    say("comparing the runs")
    begun = os.times()
    command = [sys.executable, "-P", "-m", "sms_jobs.cli.main", "run", "compare", _BEFORE, _AFTER]
    told = subprocess.run(
        [*command, "-o", str(page), "--home", str(home), "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    ended = os.times()
    if told.returncode:
        raise SmsError(f"the runs were not compared: {told.stderr.strip()}")
    differences = json.loads(told.stdout)["differences"]
    return ComparedRuns(
        ended.children_user - begun.children_user + ended.children_system - begun.children_system,
        page.stat().st_size / 1e6,
        len(differences),
        sum(one["points"] for one in differences),
    )
