"""Images of a calibration board become the poses of a calibration session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sms_jobs.app.importing.image_entry import (
    CameraSettings,
    EnteredImages,
    EntryOptions,
    arranged,
    inspect_images,
    make_campaign,
)
from sms_jobs.app.importing.outcomes import Outcome, existing_campaign
from sms_jobs.app.progress import Tell, nobody
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers import boards as board_images
from sms_jobs.formats.importers.folders import Listing, list_folder
from sms_jobs.formats.importers.frames import Arrangement
from sms_jobs.formats.importers.image_sets import named_cameras
from sms_jobs.records.artefacts import Artefact
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign
    from sms_jobs.records.sensors import Box, SensorFormat


@dataclass(frozen=True)
class Task:
    """What is asked for: which files, as what, and where to.

    Attributes
    ----------
    folder
        Of the images; its sub-folders belong to it.
    only
        Only files whose path below the folder has this form.
    pattern
        Of the files' names; guessed if it is None.
    cameras, camera
        Cameras by what the names call them, as "left=C1"; and the one that the names do not say.
    session
        Calibration session that they belong to.
    rig, volume
        Of a session that is to be made; the volume is where the calibration is to hold, in mm.
    board
        File that describes the board; or else:
    chessboard, pitch_mm
        Inner corners of a chessboard, as "9x6", and the side of its squares.
    pitch_relative_sigma, flatness_mm
        Of that chessboard, as far as they are known, see `Chessboard`.
    add_states
        Give the session poses that it does not have yet.
    """

    folder: Path
    session: str
    only: str | None = None
    pattern: str | None = None
    cameras: str | None = None
    camera: str | None = None
    rig: str | None = None
    volume: Box | None = None
    board: Path | None = None
    chessboard: str | None = None
    pitch_mm: float | None = None
    pitch_relative_sigma: float | None = None
    flatness_mm: float | None = None
    add_states: bool = False


@dataclass(frozen=True)
class Arranged:
    """What the images are taken for, before anything is entered."""

    task: Task
    listing: Listing
    pattern: str
    arrangement: Arrangement
    board: Artefact | None
    existing: Campaign | None


@use_case(Right.READ)
def arrange_boards(services: Services, task: Task) -> Arranged:
    """Say which pose and camera each image is of.

    Raises `InvalidInput` for a folder without images, and where names, board and session contradict each
    other.
    """
    listing = list_folder(task.folder, task.only)
    named = named_cameras(task.cameras)
    described = _described(task)
    text, arrangement = arranged(listing, task.pattern, task.camera, None, named)
    existing = existing_campaign(services, task.session, task.rig)
    _check(existing, task.session, task.rig, described, arrangement, task.add_states)
    return Arranged(task, listing, text, arrangement, described, existing)


@use_case(Right.COMPUTE)
def enter(services: Services, found: Arranged, how: EntryOptions, tell: Tell = nobody) -> Outcome:
    """Read all images, then enter those without fault as poses, and say what became of each.

    `tell` counts files that are read, then poses that are entered.
    """
    task, existing, settings = found.task, found.existing, CameraSettings()
    inspected = inspect_images(found.listing, found.arrangement, settings, tell)
    if existing is not None and existing.session is not None:
        inspected = board_images.of_known_size(inspected, _formats(existing))
    sensors = list(board_images.sizes(inspected).values())
    if sensors and not how.dry_run:
        poses = board_images.held_at(inspected, how.recorded_at)
        if existing is None:
            assert found.board is not None
            assert task.rig is not None
            definition = board_images.session_of_boards(
                task.session, task.rig, found.board, poses, sensors, task.volume
            )
        else:
            definition = board_images.with_poses(existing, poses)
        make_campaign(services, existing, definition)
    images = EnteredImages(services, task.session, found.listing, settings, how, tell, noise_counts=False)
    return replace(images.all_of(inspected), left_out=found.arrangement.left_out)


def _described(task: Task) -> Artefact | None:
    """Return the board that the options describe; None where they describe none."""
    if task.board is not None and task.chessboard is not None:
        raise InvalidInput("describe the board by `board` or by `chessboard`, not by both")
    if task.chessboard is not None:
        known = task.pitch_relative_sigma, task.flatness_mm
        return board_images.chessboard(task.chessboard, task.pitch_mm, *known)
    for name in ("pitch_relative_sigma", "flatness_mm"):
        if getattr(task, name) is not None:
            raise InvalidInput(f"{name} is for a chessboard: write it into the file of the board instead")
    return None if task.board is None else board_images.load_board(task.board)


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
            missing = "name the `rig`, for example stereo" if rig is None else "describe it with `board`"
            raise InvalidInput(f"there is no session {name} yet: {missing}")
        return
    if existing.session is None:
        raise InvalidInput(f"campaign {name} is no calibration session: import into another")
    if board is not None and board not in existing.session.artefacts.values():
        raise InvalidInput(
            f"session {name} shows another board: leave `board` out, or create another session"
        )
    unknown = [p for p in arrangement.views if p not in existing.views]
    if unknown:
        raise InvalidInput(
            f"session {name} has no separate camera {', '.join(unknown)}; it has {', '.join(existing.views)}"
        )
    labels = {s.label for s in existing.states}
    added = [label for label in arrangement.states if label not in labels]
    if added and not add_states:
        raise InvalidInput(
            f"session {name} has no pose {', '.join(added[:5])}: set `add_states` to add {len(added)}"
        )


def _formats(existing: Campaign) -> Mapping[str, SensorFormat]:
    assert existing.session is not None
    return {s.name: s for s in existing.session.sensors}
