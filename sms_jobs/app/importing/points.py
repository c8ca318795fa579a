"""Points of a board that another program has found become observations of a session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from sms_jobs.app.importing.outcomes import existing_campaign
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.formats.importers.board_points import BoardTable, read_points
from sms_jobs.formats.importers.boards import BOARD
from sms_jobs.jobs.archiving.importing import import_observations
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.artefacts import Chessboard
from sms_jobs.records.campaign import CalibrationSession, Campaign, LoadState, Specimen
from sms_jobs.records.people import Right
from sms_jobs.records.sensors import SensorFormat
from sms_jobs.records.sizes import number_of
from sms_jobs.records.views import view_of


@dataclass(frozen=True)
class Task:
    """What is asked for.

    Attributes
    ----------
    file
        Table of the points.
    session, rig
        Calibration session that is to be made, and the rig that it calibrates.
    view
        Camera and projector that saw the board, several cameras, or a camera alone. Of several cameras the
        session has each as a view of its own, as that of images has.
    sizes
        Columns and rows of each of these, by name.
    sigma_px
        Standard deviation of the points, in each direction.
    recorded_at
        When; now if it is None.
    pitch_relative_sigma, flatness_mm
        Of the board, as far as they are known, see `Chessboard`.
    """

    file: Path
    session: str
    rig: str
    view: str
    sizes: Mapping[str, tuple[int, int]]
    sigma_px: float = 0.1
    recorded_at: datetime | None = None
    pitch_relative_sigma: float | None = None
    flatness_mm: float | None = None


@dataclass(frozen=True)
class ImportedPoints:
    """The board, and how many points of it were seen in each pose; of several cameras, by pose/camera."""

    board: Chessboard
    counts: dict[str, int]


@use_case(Right.COMPUTE)
def import_points(services: Services, task: Task, *, dry_run: bool = False) -> ImportedPoints:
    """Enter points as a session of their own, where observing the board's images would have put them.

    Raises
    ------
    InvalidInput
        The table cannot be read, the sizes are not those of the view or leave points outside, or the view is
        one of several cameras and a projector.
    Conflict
        There is a campaign of that name.
    """
    now = datetime.now(UTC)
    seen = view_of(task.view)
    if seen.projectors and seen.other_cameras:
        raise InvalidInput(
            f"the view {seen} calibrates no projector: import the points of "
            f"{''.join(seen.triangulating)}, or of a camera and a projector like C1P2"
        )
    table = read_points(task.file, task.view, task.sigma_px)
    board = replace(table.board, pitch_relative_sigma=task.pitch_relative_sigma, flatness_mm=task.flatness_mm)
    at = task.recorded_at or now
    made = Campaign(
        name=task.session,
        specimen=Specimen(BOARD),
        rig=task.rig,
        states=tuple(LoadState(label, time=at, artefact=BOARD) for label in table.observations),
        views=tuple(str(one) for one in seen.recordings),
        session=CalibrationSession({BOARD: board}, _sensors(task.view, task.sizes)),
    )
    _refuse_outside(table, task.sizes)
    if existing_campaign(services, task.session) is not None:
        raise Conflict(f"there is a campaign {task.session} already: give another name to -c")
    if not dry_run:
        register_campaign(services.catalogue, services.archive, made, None, now)
        parameters = {"file": str(task.file), "source_sha256": table.sha256, "sigma_px": task.sigma_px}
        import_observations(services.catalogue, services.archive, made, table.observations, parameters, now)
    counts = {
        pose if len(made.views) == 1 else f"{pose}/{view}": len(seen.point)
        for pose, of_pose in table.observations.items()
        for view, seen in of_pose.items()
    }
    return ImportedPoints(board, counts)


def _sensors(view: str, sizes: Mapping[str, tuple[int, int]]) -> tuple[SensorFormat, ...]:
    sensors = view_of(view).sensors
    if set(sizes) != set(sensors):
        raise InvalidInput(
            f"give the image `size` of {' and '.join(sensors)}, not of {', '.join(sizes) or 'none'}"
        )
    return tuple(SensorFormat(name, *sizes[name]) for name in sensors)


def _refuse_outside(table: BoardTable, sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raise `InvalidInput` where a sensor has points a pixel or more outside of its image."""
    for pose, of_pose in table.observations.items():
        for seen in of_pose.values():
            for name, points in ((seen.camera, seen.camera_px), (seen.projector, seen.projector_px)):
                if not name:
                    continue
                columns, rows = sizes[name]
                outside = ((points < -1.0) | (points > (columns, rows))).any(axis=1)
                if outside.any():
                    x, y = points[outside][0]
                    raise InvalidInput(
                        f"{name} of pose {pose} has {number_of(int(outside.sum()), 'point')} outside of its "
                        f"image of {columns} x {rows} px, such as ({x:g}, {y:g}): correct the `size`, or the "
                        "columns"
                    )
