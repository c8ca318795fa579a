"""From first values to a bundle adjustment of one board, without a session."""

from __future__ import annotations

from collections.abc import Collection, Sequence

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
    board: BundleBoard,
    projectors: Collection[str] = (),
    fixed: tuple[str, ...] | None = None,
) -> BundleProblem:
    """Return the adjustment of all points of the usable views; the first board is the world's frame.

    `fixed` parameters keep their first values; by default `KEPT`, and a principal point that the start held.
    """
    names, poses = list(initial.sensors), list(initial.board_poses)
    usable = {(v.view.sensor, v.view.pose) for v in initial.views}

    def held(sigma: float) -> tuple[str, ...]:
        return fixed if fixed is not None else (*KEPT, "cx", "cy") if sigma == 0.0 else KEPT

    return BundleProblem(
        sensors=tuple(
            BundleSensor(name, s.intrinsics, s.pose, held(s.lens_sigma[2]))
            for name, s in initial.sensors.items()
        ),
        boards=(board,),
        board_poses=tuple(BoardPose(name, 0, pose) for name, pose in initial.board_poses.items()),
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
