"""Points of a board that another program has found in images: a table, and the observations that it holds."""

from __future__ import annotations

import hashlib
from collections import defaultdict
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
from sms_jobs.records.views import view_of

COLUMNS = ("state", "board_x_mm", "board_y_mm", "camera_x_px", "camera_y_px")
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
        By pose, in the order of the table.
    sha256
        Of the file.
    """

    board: Chessboard
    observations: dict[str, BoardObservation]
    sha256: str


def read_points(path: Path, view: str, sigma_px: float) -> BoardTable:
    """Read points of a board in a camera, and in a projector where the view has one.

    Parameters
    ----------
    path
        CSV with a header of `COLUMNS` and, for a projector, `PROJECTOR_COLUMNS`; a row a point.
    view
        C1P1, or C1 for a camera alone.
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
    sensors = view_of(view).sensors
    required = COLUMNS + (PROJECTOR_COLUMNS if len(sensors) > 1 else ())
    rows = _rows(path, text, required)
    places = np.array([row[:2] for points in rows.values() for row in points])
    x, y = _lines(places[:, 0]), _lines(places[:, 1])
    pitch = _pitch(path, x, y)
    observations = {
        pose: _observation(np.array(points), sensors, (x, y), sigma_px) for pose, points in rows.items()
    }
    return BoardTable(
        Chessboard(len(x), len(y), pitch), observations, hashlib.sha256(text.encode()).hexdigest()
    )


def _rows(path: Path, text: str, required: tuple[str, ...]) -> dict[str, list[list[float]]]:
    header, read = csv_rows(text.splitlines(), str(path))
    missing = [name for name in required if name not in header]
    if missing:
        raise InvalidInput(
            f"{path} has no column {', '.join(missing)}: its header should have {', '.join(required)}"
        )
    rows: dict[str, list[list[float]]] = defaultdict(list)
    for number, row in enumerate(read, start=2):
        values = []
        for name in required[1:]:
            try:
                values.append(float(row[name] or ""))
            except ValueError:
                values.append(float("nan"))
            if not isfinite(values[-1]):
                raise InvalidInput(
                    f"{path}, line {number}: '{printable(row[name] or '')}' in column '{name}' is no finite "
                    "number: leave the point out"
                )
        rows[checked_name(row["state"] or "", "state")].append(values)
    for pose, points in rows.items():
        if len({(p[0], p[1]) for p in points}) < len(points):
            raise InvalidInput(f"{path} has a point of pose {pose} twice: leave one out")
    if not rows:
        raise InvalidInput(f"{path} has a header and no row")
    return dict(rows)


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
    points: NDArray[np.float64],
    sensors: tuple[str, ...],
    lines: tuple[NDArray[np.float64], NDArray[np.float64]],
    sigma_px: float,
) -> BoardObservation:
    count = len(points)
    place = np.stack(
        [np.searchsorted(line, points[:, k] - 2.0 * _SAME_MM) for k, line in enumerate(lines)], axis=-1
    )
    alone = len(sensors) == 1
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
    )
