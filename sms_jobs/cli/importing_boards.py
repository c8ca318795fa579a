"""`sms import boards`: images of a calibration board become the poses of a calibration session."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.cli import output
from sms_jobs.cli.image_entry import EnteredImages, GivenCamera, arranged, inspect_images, make_campaign
from sms_jobs.cli.import_options import (
    AddStates,
    Cameras,
    CampaignName,
    DryRun,
    Newer,
    Only,
    RecordedAt,
    Yes,
)
from sms_jobs.cli.import_outcomes import TOLD, confirm, existing_campaign, tell, time_given
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers import boards as board_images
from sms_jobs.formats.importers.folders import list_folder
from sms_jobs.formats.importers.frames import Arrangement
from sms_jobs.formats.importers.image_sets import named_cameras
from sms_jobs.records.artefacts import Artefact
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.sensors import Box, SensorFormat

_Six = tuple[float, float, float, float, float, float]


def boards(
    folder: Annotated[Path, typer.Argument(help="Folder of the images; its sub-folders belong to it.")],
    campaign: CampaignName,
    pattern: Annotated[
        str | None, typer.Option(help="File names, as dot_{state}_{camera}.png; * for anything.")
    ] = None,
    cameras: Cameras = None,
    camera: Annotated[str | None, typer.Option(help="Camera, where the names do not say it: C1.")] = None,
    only: Only = None,
    rig: Annotated[str | None, typer.Option(help="Rig of a session that is to be made.")] = None,
    board: Annotated[
        Path | None, typer.Option(help="File (TOML) that describes the board; see docs/calibration.md.")
    ] = None,
    chessboard: Annotated[
        str | None, typer.Option(help="Instead of --board: inner corners of a chessboard, as 9x6.")
    ] = None,
    pitch_mm: Annotated[
        float | None, typer.Option("--pitch-mm", help="Side of a square of the chessboard.", min=1e-3)
    ] = None,
    volume: Annotated[
        _Six | None,
        typer.Option(
            help="Where the calibration is to hold, in the first board's frame in mm: lower, upper corner.",
            metavar="X Y Z X Y Z",
        ),
    ] = None,
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
    listing = list_folder(folder, only)
    at = time_given(recorded_at)
    named = named_cameras(cameras)
    described = _described(board, chessboard, pitch_mm)
    box = None if volume is None else _box(volume)
    text, arrangement = arranged(listing, pattern, camera, None, named)
    with bootstrap.services(home) as services:
        existing = existing_campaign(services, campaign)
        _check(existing, campaign, rig, described, arrangement, add_states)
        _preview(text, arrangement)
        if pattern is None and not (yes or dry_run):
            confirm("Is this right?")
        settings = GivenCamera()
        inspected = inspect_images(listing, arrangement, settings)
        if existing is not None and existing.session is not None:
            inspected = board_images.of_known_size(inspected, _known(existing))
        sensors = list(board_images.sizes(inspected).values())
        if sensors and not dry_run:
            poses = board_images.held_at(inspected, at)
            if existing is None:
                assert described is not None
                assert rig is not None
                wanted = board_images.session_of_boards(campaign, rig, described, poses, sensors, box)
            else:
                wanted = board_images.with_poses(existing, poses)
            make_campaign(services, existing, wanted)
        enter = EnteredImages(services, campaign, listing, settings, at, newer, dry_run, noise_counts=False)
        outcome = enter.all_of(inspected)
    tell(
        outcome,
        arrangement.left_out,
        as_json=as_json,
        dry_run=dry_run,
        campaign=campaign,
        then="pipeline",
    )


def _described(board: Path | None, corners: str | None, pitch_mm: float | None) -> Artefact | None:
    """Return the board that the options describe; None where they describe none."""
    if board is not None and corners is not None:
        raise InvalidInput("say what the board is by --board or by --chessboard, not by both")
    if board is not None:
        return board_images.load_board(board)
    return None if corners is None else board_images.chessboard(corners, pitch_mm)


def _box(volume: _Six) -> Box:
    low, high = volume[:3], volume[3:]
    if any(a >= b for a, b in zip(low, high, strict=True)):
        raise InvalidInput(
            f"--volume has the lower corner {low} and the upper {high}: every coordinate of the first has to "
            "be below that of the second"
        )
    return Box(low, high)


def _check(
    existing: Campaign | None,
    name: str,
    rig: str | None,
    board: Artefact | None,
    arrangement: Arrangement,
    add_states: bool,
) -> None:
    """Refuse what contradicts the session that is there, or what leaves a new one undescribed."""
    if existing is None:
        if rig is None or board is None:
            missing = "name the rig, as --rig stereo" if rig is None else "say what the board is, as --board"
            raise InvalidInput(f"there is no session {name} yet: {missing}")
        return
    if existing.session is None:
        raise InvalidInput(f"campaign {name} is no calibration session: import into another")
    if board is not None and board not in existing.session.artefacts.values():
        raise InvalidInput(f"session {name} shows another board: leave --board out, or make another session")
    unknown = [p for p in arrangement.views if p not in existing.views]
    if unknown:
        raise InvalidInput(
            f"session {name} has no camera {', '.join(unknown)} by itself; it has {', '.join(existing.views)}"
        )
    known = {s.label for s in existing.states}
    added = [label for label in arrangement.states if label not in known]
    if added and not add_states:
        raise InvalidInput(
            f"session {name} has no pose {', '.join(added[:5])}: say --add-states to add {len(added)}"
        )


def _known(existing: Campaign) -> Mapping[str, SensorFormat]:
    assert existing.session is not None
    return {s.name: s for s in existing.session.sensors}


def _preview(text: str, arrangement: Arrangement) -> None:
    output.say(f"pattern   {text}")
    for one in arrangement.tuples[:TOLD]:
        output.say(f"  {one.white}  pose {one.state}, camera {one.view}")
    if len(arrangement.tuples) > TOLD:
        output.say(f"  and {len(arrangement.tuples) - TOLD} more")
