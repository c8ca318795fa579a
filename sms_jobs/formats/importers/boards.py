"""Images of calibration boards: what the board is, which sensors saw it, and the session that they make."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, TypeAlias

from pydantic import RootModel

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.frames import abridged
from sms_jobs.formats.importers.inspection import Inspected
from sms_jobs.formats.interchange.text_files import read_text
from sms_jobs.formats.record_tables import flat
from sms_jobs.formats.session_tables import check_artefact
from sms_jobs.formats.written_files import read_toml, validated
from sms_jobs.records.artefacts import Artefact, Chessboard, CircleBoard, DotCylinder
from sms_jobs.records.campaign import CalibrationSession, Campaign, LoadState, Specimen
from sms_jobs.records.sensors import Box, SensorFormat

BOARD = "board"
"""What the board of a session is called that is made from images."""

_Board: TypeAlias = CircleBoard | DotCylinder | Chessboard
_SIZE = re.compile(r"(\d{1,3})x(\d{1,3})")
_LONGEST = 200


class _BoardFile(RootModel[Annotated[_Board, flat(CircleBoard, DotCylinder, Chessboard, tag="shape")]]):
    """A file that describes one board."""


def load_board(path: Path) -> Artefact:
    """Read the description of a board, as it is under [session.artefacts] of a session.

    Raises `ConfigurationError` for what describes none, `NotFound` where there is no such file.
    """
    content, places = read_toml(read_text(path, "file of a board"), str(path))

    def checked(found: _BoardFile) -> Artefact:
        check_artefact(BOARD, found.root)
        return found.root

    hint = "docs/calibration.md shows boards"
    return validated(_BoardFile, content, places, hint, checked)


def chessboard(
    size: str,
    pitch_mm: float | None,
    pitch_relative_sigma: float | None = None,
    flatness_mm: float | None = None,
) -> Chessboard:
    """Return the chessboard that `9x6` inner corners make; raise `InvalidInput` for anything else.

    How well the pitch is known and how flat the board is may be unknown, see `Chessboard`.
    """
    found = _SIZE.fullmatch(size)
    if found is None or not all(3 <= int(n) <= _LONGEST for n in found.groups()):
        raise InvalidInput(
            f"`chessboard` should be its inner corners, columns x rows from 3x3 to {_LONGEST}x{_LONGEST}, "
            f"for example 9x6, not '{size}'"
        )
    if pitch_mm is None:
        raise InvalidInput("the scale of the chessboard is not known: give `pitch_mm`, the side of a square")
    return Chessboard(
        int(found[1]),
        int(found[2]),
        pitch_mm,
        pitch_relative_sigma=pitch_relative_sigma,
        flatness_mm=flatness_mm,
    )


def session_of_boards(
    name: str,
    rig: str,
    board: Artefact,
    poses: Mapping[str, datetime],
    sensors: Sequence[SensorFormat],
    volume: Box | None,
) -> Campaign:
    """Return a calibration session of cameras that saw a board in several poses, at a time each."""
    return Campaign(
        name=name,
        specimen=Specimen(BOARD),
        rig=rig,
        states=tuple(LoadState(label, time=at, artefact=BOARD) for label, at in poses.items()),
        views=tuple(s.name for s in sensors),
        session=CalibrationSession({BOARD: board}, tuple(sensors), volume),
    )


def with_poses(campaign: Campaign, poses: Mapping[str, datetime]) -> Campaign:
    """Return a session with further poses of its board behind its own."""
    assert campaign.session is not None
    known = {s.label for s in campaign.states}
    board = campaign.states[0].artefact
    added = tuple(LoadState(k, time=at, artefact=board) for k, at in poses.items() if k not in known)
    return replace(campaign, states=campaign.states + added)


def held_at(inspected: Iterable[Inspected], recorded_at: datetime | None) -> dict[str, datetime]:
    """Return when each pose was held, as it is given or by the files; of those that have no fault."""
    times: dict[str, datetime] = {}
    for one in inspected:
        if not one.found.faults:
            at = recorded_at or one.recorded_at
            times[one.found.state] = min(at, times.get(one.found.state, at))
    return times


def sizes(inspected: Iterable[Inspected]) -> dict[str, SensorFormat]:
    """Return the size of the images of each camera, of those that have no fault."""
    found: dict[str, SensorFormat] = {}
    for one in inspected:
        for about in one.facts.values():
            if not one.found.faults:
                found.setdefault(one.found.view, SensorFormat(one.found.view, about.columns, about.rows))
    return found


def of_known_size(inspected: Sequence[Inspected], known: Mapping[str, SensorFormat]) -> list[Inspected]:
    """Add a fault to images whose size is not that which the session has of their camera."""
    checked = []
    for one in inspected:
        sensor, about = known.get(one.found.view), next(iter(one.facts.values()), None)
        if sensor and about and (about.columns, about.rows) != (sensor.columns, sensor.rows):
            fault = (
                f"it has {about.columns} x {about.rows} px, but the session says that {sensor.name} has "
                f"{sensor.columns} x {sensor.rows}: import it into a session of its own"
            )
            found = replace(one.found, faults=abridged([*one.found.faults, fault]))
            one = replace(one, found=found)
        checked.append(one)
    return checked
