"""`sms import boards`: images of a calibration board become the poses of a calibration session."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from sms_jobs import bootstrap
from sms_jobs.cli import bars, output
from sms_jobs.cli.importing.options import (
    AddStates,
    Cameras,
    CampaignName,
    DryRun,
    Flatness,
    Folder,
    LoneCamera,
    Newer,
    Only,
    PitchSigma,
    RecordedAt,
    Yes,
)
from sms_jobs.cli.importing.outcomes import MOST_SHOWN, confirm, tell_outcome, time_given
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.records.sensors import Box

if TYPE_CHECKING:
    from sms_jobs.app.importing.boards import Arranged

_Six = tuple[float, float, float, float, float, float]

Pattern: TypeAlias = Annotated[
    str | None, typer.Option(help="File names, as dot_{state}_{camera}.png; * for anything.")
]
NewRig: TypeAlias = Annotated[str | None, typer.Option(help="Rig of a session that is to be made.")]
BoardFile: TypeAlias = Annotated[
    Path | None, typer.Option(help="File (TOML) that describes the board; see docs/calibration.md.")
]
Chessboard: TypeAlias = Annotated[
    str | None, typer.Option(help="Instead of --board: inner corners of a chessboard, as 9x6.")
]
PitchMm: TypeAlias = Annotated[
    float | None, typer.Option("--pitch-mm", help="Side of a square of the chessboard.", min=1e-3)
]
Volume: TypeAlias = Annotated[
    _Six | None,
    typer.Option(
        help="Where the calibration is to hold, in the first board's frame in mm: lower, upper corner.",
        metavar="X Y Z X Y Z",
    ),
]


def boards(
    folder: Folder,
    campaign: CampaignName,
    pattern: Pattern = None,
    cameras: Cameras = None,
    camera: LoneCamera = None,
    only: Only = None,
    rig: NewRig = None,
    board: BoardFile = None,
    chessboard: Chessboard = None,
    pitch_mm: PitchMm = None,
    pitch_relative_sigma: PitchSigma = None,
    flatness_mm: Flatness = None,
    volume: Volume = None,
    recorded_at: RecordedAt = None,
    add_states: AddStates = False,
    newer: Newer = False,
    dry_run: DryRun = False,
    yes: Yes = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Import images of a calibration board, one a pose and camera, as a calibration session.

    Of several cameras, the images of one pose are of one state. Cameras are calibrated alone or together;
    for a projector import frames of the board, with the session as --plan of 'sms import frames'.

    Example: sms import boards chess -c camera-june --rig bench --chessboard 9x6 --pitch-mm 25

    Example: sms import boards dots -c stereo-june --rig stereo --board board.toml --pattern
    'dot_{state}_{camera}.jpeg' --cameras '0=C1 1=C2'
    """
    from sms_jobs.app.importing.boards import Task, arrange_boards, enter
    from sms_jobs.app.importing.image_entry import EntryOptions

    how = EntryOptions(time_given(recorded_at), newer, dry_run)
    task = Task(
        folder,
        campaign,
        only=only,
        pattern=pattern,
        cameras=cameras,
        camera=camera,
        rig=rig,
        volume=None if volume is None else _box(volume),
        board=board,
        chessboard=chessboard,
        pitch_mm=pitch_mm,
        pitch_relative_sigma=pitch_relative_sigma,
        flatness_mm=flatness_mm,
        add_states=add_states,
    )
    with bootstrap.services(home) as services:
        found = arrange_boards(services, task)
        _preview(found)
        if pattern is None and not (yes or dry_run):
            confirm("Is this right?")
        with bars.followed(bars.progress_bar()) as tell:
            outcome = enter(services, found, how, tell)
    tell_outcome(outcome, as_json=as_json, dry_run=dry_run, campaign=campaign, then="pipeline")


def _box(volume: _Six) -> Box:
    low, high = volume[:3], volume[3:]
    if any(a >= b for a, b in zip(low, high, strict=True)):
        raise InvalidInput(
            f"--volume has the lower corner {low} and the upper {high}: every coordinate of the first has to "
            "be below that of the second"
        )
    return Box(low, high)


def _preview(found: Arranged) -> None:
    arrangement = found.arrangement
    output.say(f"pattern   {found.pattern}")
    for one in arrangement.tuples[:MOST_SHOWN]:
        output.say(f"  {one.white}  pose {one.state}, camera {one.view}")
    if len(arrangement.tuples) > MOST_SHOWN:
        output.say(f"  and {len(arrangement.tuples) - MOST_SHOWN} more")
