"""`sms import points`: points of a board that another program has found become observations of a session."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.cli import output
from sms_jobs.cli.importing.options import CampaignName, DryRun, Flatness, PitchSigma
from sms_jobs.cli.importing.outcomes import time_given
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput

_SIZE = re.compile(r"(\d{1,5})x(\d{1,5})")


def points(
    file: Annotated[Path, typer.Argument(help="Table (CSV) of points; see docs/import.md.")],
    campaign: CampaignName,
    rig: Annotated[str, typer.Option(help="Rig that is calibrated.")],
    view: Annotated[
        str, typer.Option(help="Camera and projector that saw the board, C1P1, cameras, C1C2, or C1 alone.")
    ],
    size: Annotated[
        list[str], typer.Option(help="Image size of each sensor in px, as C1=1280x960; repeat for the other.")
    ],
    sigma_px: Annotated[
        float,
        typer.Option("--sigma-px", help="Standard deviation of the points, in each direction.", min=1e-4),
    ] = 0.1,
    pitch_relative_sigma: PitchSigma = None,
    flatness_mm: Flatness = None,
    recorded_at: Annotated[
        str | None,
        typer.Option("--recorded-at", help="When, as 2026-05-04T10:00:00+02:00; now if not given."),
    ] = None,
    dry_run: DryRun = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Import points of a board that another program has found, as a calibration session of its own.

    They stand where the job kind observe-board would have put them: calibrate-boards goes on with them. The
    table of several cameras has columns C1_x_px, C1_y_px, C2_x_px, C2_y_px; what a camera lacks is empty.

    Example: sms import points corners.csv -c june --rig desk --view C1P1 --size C1=1280x960 --size
    P1=1024x768

    Example: sms import points corners.csv -c june --rig stereo --view C1C2 --size C1=1280x960 --size
    C2=1280x960
    """
    from sms_jobs.app.importing.points import Task, import_points

    task = Task(
        file,
        campaign,
        rig,
        view,
        _sizes(size),
        sigma_px,
        time_given(recorded_at),
        pitch_relative_sigma,
        flatness_mm,
    )
    with bootstrap.services(home) as services:
        found = import_points(services, task, dry_run=dry_run)
    board, counts = found.board, found.counts
    if as_json:
        output.print_json({"campaign": campaign, "dry_run": dry_run, "board": board, "points": counts})
        return
    output.say(f"board     {board.columns} x {board.rows} points, {board.pitch_mm:g} mm apart")
    output.print_table(["pose", "points"], list(counts.items()), empty="")
    output.say(
        "nothing was changed" if dry_run else f"next: sms job submit calibrate-boards --campaign {campaign}"
    )


def _sizes(texts: list[str]) -> dict[str, tuple[int, int]]:
    found = {}
    for text in texts:
        name, _, rest = text.partition("=")
        match = _SIZE.fullmatch(rest)
        if match is None or int(match[1]) < 1 or int(match[2]) < 1:
            raise InvalidInput(f"--size should be as in C1=1280x960, not '{text}'")
        found[name] = (int(match[1]), int(match[2]))
    return found
