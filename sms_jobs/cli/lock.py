"""`sms lock`: who holds which device."""

from __future__ import annotations

from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.measuring import rigs
from sms_jobs.cli import output
from sms_jobs.cli.asking import Reason, because
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.job import SHORT_ID

app = typer.Typer(help="Devices that a job or a person holds.", no_args_is_help=True)


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show which devices are held, by whom and since when.

    Example: sms lock list
    """
    with bootstrap.services(home) as services:
        found = rigs.held_devices(services)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["device", "held by", "since", "until", "holder"],
        [
            (
                lock.device,
                lock.holder
                if lock.job_id is None
                else f"job {lock.job_id[:SHORT_ID]}: {lock.kind} {lock.subject}",
                lock.since,
                lock.lease_until or "it ends",
                "alive" if lock.alive else "gone: the device is free",
            )
            for lock in found
        ],
        empty="no device is held",
    )


@app.command()
def release(
    device: Annotated[str, typer.Argument(help="Name of a device; see 'sms lock list'.")],
    reason: Reason = None,
    home: Home = None,
) -> None:
    """Forget a lock whose holder is gone; one that is alive keeps its device.

    A supervisor does the same by itself within seconds.

    Example: sms lock release rig-1/camera-C1
    """
    with bootstrap.services(home) as services:
        gone = rigs.release(because(services, reason), device)
    output.say(f"released {gone}")
