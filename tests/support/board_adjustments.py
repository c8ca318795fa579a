"""Bundle adjustments of views of one exact board, from first values: no session around them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from sms_jobs.metrology.calibration.board_views import BoardView
from sms_jobs.metrology.calibration.bundle.problem import (
    BoardPoints,
    BoardPose,
    BundleBoard,
    BundleProblem,
    BundleSensor,
)
from sms_jobs.metrology.calibration.starting.initialisation import InitialCalibration
from sms_jobs.metrology.geometry.lens import KEPT


def board_problem(
    initial: InitialCalibration,
    views: Sequence[BoardView],
    projectors: Collection[str] = (),
    fixed: tuple[str, ...] = KEPT,
) -> BundleProblem:
    """Return the adjustment of all points of the usable views, in the world of the initial calibration."""
    names, poses = list(initial.sensors), list(initial.board_poses)
    usable = {(v.view.sensor, v.view.pose) for v in initial.views}
    return BundleProblem(
        sensors=tuple(
            BundleSensor(n, s.intrinsics, s.pose, s.size_px, fixed) for n, s in initial.sensors.items()
        ),
        boards=(BundleBoard("board", 0.0, 0.0),),
        board_poses=tuple(BoardPose(p, 0, pose) for p, pose in initial.board_poses.items()),
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
