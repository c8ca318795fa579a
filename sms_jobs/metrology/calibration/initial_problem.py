"""From first values to a bundle adjustment of boards."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.calibration.board_views import BoardView
from sms_jobs.metrology.calibration.bundle_problem import (
    BoardPoints,
    BoardPose,
    BundleBoard,
    BundleProblem,
    BundleSensor,
)
from sms_jobs.metrology.calibration.initialisation import InitialCalibration
from sms_jobs.metrology.geometry.lens import KEPT


def board_problem(
    initial: InitialCalibration,
    views: Sequence[BoardView],
    boards: Sequence[BundleBoard],
    *,
    shown: Mapping[str, str] | None = None,
    projectors: Collection[str] = (),
    fixed: Mapping[str, tuple[str, ...]] | None = None,
) -> BundleProblem:
    """Return the bundle adjustment of everything that was seen of boards.

    Parameters
    ----------
    initial
        Where it starts, and which views can be used at all.
    views
        As they were given to `initialise`. All points of a usable view take part: an adjustment judges them
        better than the start could.
    boards
        How well each board is known.
    shown
        Name of the board that each pose shows; needed for more than one board.
    projectors
        Names of the sensors that are projectors.
    fixed
        Of a sensor, the parameters that are kept; `KEPT` by default, and what the start had to hold.

    Returns
    -------
    With the first board as the world's frame, and its pitch as the scale.

    Raises
    ------
    InvalidInput
        When a pose shows a board that is not among `boards`, or it is not said which.
    """
    names, poses = list(initial.sensors), list(initial.board_poses)
    known = [board.name for board in boards]

    def board_of(pose: str) -> int:
        name = known[0] if shown is None and len(known) == 1 else (shown or {}).get(pose)
        if name not in known:
            raise InvalidInput(f"pose {pose} shows the board '{name}', but known are {', '.join(known)}")
        return known.index(name)

    usable = {(v.view.sensor, v.view.pose) for v in initial.views}
    return BundleProblem(
        sensors=tuple(
            BundleSensor(
                name,
                sensor.intrinsics,
                sensor.pose,
                (fixed or {}).get(name, (*KEPT, "cx", "cy") if sensor.lens_sigma[2] == 0.0 else KEPT),
            )
            for name, sensor in initial.sensors.items()
        ),
        boards=tuple(boards),
        board_poses=tuple(BoardPose(p, board_of(p), pose) for p, pose in initial.board_poses.items()),
        board_points=tuple(
            BoardPoints(
                poses.index(v.pose),
                names.index(v.sensor),
                v.sensor in projectors,
                v.point,
                v.pixel,
                v.sigma_px,
            )
            for v in views
            if (v.sensor, v.pose) in usable
        ),
        world_board=poses.index(initial.world_pose),
    )
