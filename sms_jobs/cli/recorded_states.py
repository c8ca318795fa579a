"""`sms acquire show`: the states of a test while it goes on."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Annotated

import typer
from rich.live import Live
from rich.table import Table

from sms_jobs import bootstrap
from sms_jobs.app.measuring import recordings
from sms_jobs.bootstrap import Services
from sms_jobs.cli import output
from sms_jobs.cli.options import CampaignArgument
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.shown.state_progress import StateProgress

_EVERY_S = 2.0
_COLUMNS = ("state", "planned [N]", "read", "recording", "verdict", "processing", "mm", "microstrain")


def show(
    campaign: CampaignArgument,
    watch: Annotated[
        bool, typer.Option("--watch", help="Go on showing it until Ctrl-C, every two seconds.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show the states of a test: what is recorded, how good it is, and what is known of it already.

    The last columns are the largest displacement, in mm, and the largest principal strain of all views.

    Example: sms acquire show wing-fatigue --watch
    """
    with bootstrap.services(home) as services:
        if as_json:
            output.print_json_list(recordings.progress(services, campaign))
        elif watch:
            _watch(services, campaign)
        else:
            output.print_table(
                _COLUMNS, map(_row, recordings.progress(services, campaign)), empty="there is no state"
            )


def _watch(services: Services, campaign: str) -> None:
    with suppress(KeyboardInterrupt), Live(console=output.answer(), auto_refresh=False) as live:
        while True:
            live.update(_table(map(_row, recordings.progress(services, campaign))), refresh=True)
            time.sleep(_EVERY_S)


def _table(rows: Iterable[tuple[object, ...]]) -> Table:
    return output.table_of(_COLUMNS, [[output.shown(cell) for cell in row] for row in rows])


def _row(state: StateProgress) -> tuple[object, ...]:
    verdict = f"{state.judged} good" if state.judged else ""
    if state.doubtful:
        verdict = f"{state.doubtful} of {state.judged} doubtful"
    processing = {
        "to do": state.processing,
        "failed": state.failed,
        "skipped": state.skipped,
        "cancelled": state.cancelled,
    }
    return (
        state.label,
        state.load_n,
        ", ".join(f"{name} {value:g}" for name, value in state.channels.items()),
        state.recording,
        verdict,
        ", ".join(f"{count} {what}" for what, count in processing.items() if count),
        state.displacement_mm,
        None if state.strain is None else f"{1e6 * state.strain:.0f}",
    )
