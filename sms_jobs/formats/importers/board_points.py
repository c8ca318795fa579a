"""Points of a board that another program has found in images: a table, and the observations that it holds."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.csv_tables import csv_rows
from sms_jobs.formats.importers.boards import BOARD
from sms_jobs.formats.importers.folders import printable
from sms_jobs.formats.interchange.text_files import read_text
from sms_jobs.records.artefacts import Chessboard
from sms_jobs.records.observations import BoardObservation
from sms_jobs.records.subject import checked_name
from sms_jobs.records.views import View, view_of

PLACE_COLUMNS = ("state", "board_x_mm", "board_y_mm")
CAMERA_COLUMNS = ("camera_x_px", "camera_y_px")
PROJECTOR_COLUMNS = ("projector_x_px", "projector_y_px")
_SAME_MM = 1e-3  # places of one column or row, however they were rounded


@dataclass(frozen=True)
class BoardTable:
    """What a table of points holds.

    Attributes
    ----------
    board
        The regular grid that its points are on.
    observations
        By pose, in the order of the table, and by the view that is recorded: of several cameras each alone.
    sha256
        Of the file.
    """

    board: Chessboard
    observations: dict[str, dict[str, BoardObservation]]
    sha256: str


def read_points(path: Path, view: str, sigma_px: float) -> BoardTable:
    """Read points of a board in a camera, and in a projector or in other cameras where the view has them.

    Parameters
    ----------
    path
        CSV with a header of `PLACE_COLUMNS` and those of the sensors, see `sensor_columns`; a row a point.
    view
        C1P1, C1 for a camera alone, C1C2 for several cameras. A point that one of these has not seen has
        empty cells for it.
    sigma_px
        Standard deviation of the points in each direction; the table does not tell it.

    Raises
    ------
    NotFound
        There is no such file.
    InvalidInput
        It is no such table, its points are on no regular grid, or a pose has too few.
    """
    text = read_text(path, "table of points")
    recorded = view_of(view).recordings
    columns = {str(one): sensor_columns(one, len(recorded) > 1) for one in recorded}
    rows = _rows(path, text, columns)
    places = np.array([row for pose in rows.values() for points in pose.values() for row in points])[:, :2]
    x, y = _lines(places[:, 0]), _lines(places[:, 1])
    pitch = _pitch(path, x, y)
    observations = {
        pose: {str(one): _observation(of_pose[str(one)], one.sensors, (x, y), sigma_px) for one in recorded}
        for pose, of_pose in rows.items()
    }
    return BoardTable(
        Chessboard(len(x), len(y), pitch), observations, hashlib.sha256(text.encode()).hexdigest()
    )


def sensor_columns(view: View, one_of_several: bool) -> tuple[str, ...]:
    """Return the columns of a recorded view: `C2_x_px` where there are several cameras."""
    if one_of_several:
        return f"{view.camera}_x_px", f"{view.camera}_y_px"
    return CAMERA_COLUMNS + (PROJECTOR_COLUMNS if view.projectors else ())


def _rows(
    path: Path, text: str, columns: dict[str, tuple[str, ...]]
) -> dict[str, dict[str, list[list[float]]]]:
    """Return place on the board and images of each point, by pose and view."""
    header, read = csv_rows(text.splitlines(), str(path))
    required = PLACE_COLUMNS + tuple(name for own in columns.values() for name in own)
    missing = [name for name in required if name not in header]
    if missing:
        raise InvalidInput(
            f"{path} has no column {', '.join(missing)}: its header should have {', '.join(required)}"
        )
    rows: dict[str, dict[str, list[list[float]]]] = {}
    places = set()
    for number, row in enumerate(read, start=2):
        pose = checked_name(row["state"] or "", "state")
        place = _numbers(path, number, row, PLACE_COLUMNS[1:])
        if (pose, *place) in places:
            raise InvalidInput(f"{path} has a point of pose {pose} twice: leave one out")
        places.add((pose, *place))
        of_pose = rows.setdefault(pose, {view: [] for view in columns})
        for view, own in columns.items():
            # Of several cameras one may not have seen the point.
            if len(columns) == 1 or any((row[name] or "").strip() for name in own):
                of_pose[view].append(place + _numbers(path, number, row, own))
    if not any(points for of_pose in rows.values() for points in of_pose.values()):
        raise InvalidInput(f"{path} has a header and no row")
    return rows


def _numbers(path: Path, number: int, row: Mapping[str, str | None], names: Sequence[str]) -> list[float]:
    found = []
    for name in names:
        try:
            found.append(float(row[name] or ""))
        except ValueError:
            found.append(float("nan"))
        if not isfinite(found[-1]):
            raise InvalidInput(
                f"{path}, line {number}: '{printable(row[name] or '')}' in column '{name}' is no finite "
                "number: leave the point out"
            )
    return found


def _lines(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the coordinates of the lines of a grid, ascending."""
    return np.unique(np.round(values / _SAME_MM)) * _SAME_MM


def _pitch(path: Path, x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    steps = np.array([b - a for line in (x, y) for a, b in pairwise(line)])
    if len(x) < 3 or len(y) < 3 or steps.max() - steps.min() > 2.0 * _SAME_MM:
        raise InvalidInput(
            f"the points of {path} are on no square grid of 3 x 3 or more: board_x_mm and board_y_mm are "
            "places on the board itself"
        )
    return float(steps.mean())


def _observation(
    rows: Sequence[Sequence[float]],
    sensors: tuple[str, ...],
    lines: tuple[NDArray[np.float64], NDArray[np.float64]],
    sigma_px: float,
) -> BoardObservation:
    count, alone = len(rows), len(sensors) == 1
    points = np.array(rows, np.float64).reshape(count, 4 if alone else 6)
    place = np.stack(
        [np.searchsorted(line, points[:, k] - 2.0 * _SAME_MM) for k, line in enumerate(lines)], axis=-1
    )
    return BoardObservation(
        sensors[0],
        "" if alone else sensors[1],
        BOARD,
        float("nan"),
        {},
        place.astype(np.int32),
        np.pad(points[:, :2], ((0, 0), (0, 1))),
        points[:, 2:4],
        np.full(count, sigma_px),
        np.full((count, 2), np.nan) if alone else points[:, 4:6],
        np.full(count, np.nan if alone else sigma_px),
        reason="" if count else "the table has no point of this pose in this camera",
    )
