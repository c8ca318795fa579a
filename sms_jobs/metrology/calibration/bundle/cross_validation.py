"""Held-out poses: how accurate a calibration is on artefacts that took no part in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isinf

import numpy as np

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.calibration.bundle.adjustment import adjust
from sms_jobs.metrology.calibration.bundle.problem import (
    BoardPose,
    BundleBoard,
    BundleOptions,
    BundleProblem,
    ResidualType,
)
from sms_jobs.metrology.calibration.bundle.result import Adjustment
from sms_jobs.metrology.calibration.estimates import SHAPE, Estimated
from sms_jobs.metrology.geometry.camera import SENSOR_PARAMETERS


@dataclass(frozen=True)
class HeldOutBar:
    """A ball bar, measured with a calibration that its pose took no part in.

    Attributes
    ----------
    pose
        Name.
    length_mm, error_mm
        Distance of the spheres' centres, and what it is more than certified; NaN where too few points fit.
    """

    pose: str
    length_mm: float
    error_mm: float


@dataclass(frozen=True)
class HeldOutBoard:
    """A board, seen with a calibration that its pose took no part in.

    Attributes
    ----------
    pose
        Name.
    camera_rms_px, projector_rms_px
        Of each coordinate of the reprojection; NaN where none saw it.
    """

    pose: str
    camera_rms_px: float
    projector_rms_px: float


@dataclass(frozen=True)
class CrossValidation:
    """Every pose held out once.

    Attributes
    ----------
    bars, boards
        One each pose.
    bar_rms_mm
        Rms of the length errors; NaN without bars.
    camera_rms_px, projector_rms_px
        Rms of the reprojection over all boards; NaN without.
    failed
        Why folds or poses have no result.
    """

    bars: tuple[HeldOutBar, ...]
    boards: tuple[HeldOutBoard, ...]
    bar_rms_mm: float
    camera_rms_px: float
    projector_rms_px: float
    failed: tuple[str, ...]


def restarted(problem: BundleProblem, adjustment: Adjustment) -> BundleProblem:
    """Return a problem that starts from what an adjustment of it found.

    The sensors of a problem with a prior keep their start, which the prior is about.
    """
    sensors = problem.sensors
    if problem.prior is None:
        sensors = tuple(
            replace(old, intrinsics=new.intrinsics, pose=new.pose)
            for old, new in zip(problem.sensors, adjustment.sensors, strict=True)
        )
    boards = zip(problem.board_poses, adjustment.board_poses, strict=True)
    bars = zip(problem.bar_poses, adjustment.centres, strict=True)
    return replace(
        problem,
        sensors=sensors,
        board_poses=tuple(BoardPose(old.name, old.board, pose) for old, pose in boards),
        bar_poses=tuple(replace(old, centres=np.where(np.isfinite(c), c, old.centres)) for old, c in bars),
    )


def cross_validate(
    problem: BundleProblem,
    options: BundleOptions | None = None,
    folds: int = 5,
    start: Adjustment | None = None,
) -> CrossValidation:
    """Hold every pose out once, calibrate without it, and measure its artefact with that calibration.

    Parameters
    ----------
    problem, options
        As of `adjust`.
    folds
        In how many parts the poses are held out; the pose that is the world takes part always.
    start
        An adjustment of the same problem to start from, which saves iterations.

    Raises
    ------
    InvalidInput
        For fewer than two folds.
    """
    if folds < 2:
        raise InvalidInput(f"{folds} folds hold nothing out; ask for at least 2")
    quiet = replace(options or BundleOptions(), judge_points=False)
    begun = problem if start is None else restarted(problem, start)
    boards = [k for k in range(len(problem.board_poses)) if k != problem.world_board]
    bars: list[HeldOutBar] = []
    seen: list[HeldOutBoard] = []
    failed = []
    for fold in range(folds):
        held_bars = set(range(fold, len(problem.bar_poses), folds))
        held_boards = set(boards[fold::folds])
        if not held_bars and not held_boards:
            continue
        try:
            found = adjust(_without(begun, held_bars, held_boards), quiet)
            measured = adjust(_alone(begun, found, held_bars, held_boards), quiet)
        except CalibrationFailed as refused:
            failed.append(f"fold {fold + 1}: {refused}")
            continue
        lengths = _lengths(problem, measured, held_bars)
        bars += lengths
        lost = [b.pose for b in lengths if not np.isfinite(b.length_mm)]
        failed += [f"pose {name}: too few points of its spheres fit" for name in lost]
        seen += _reprojections(problem, measured, held_boards)
    return CrossValidation(
        tuple(sorted(bars, key=lambda b: [p.name for p in problem.bar_poses].index(b.pose))),
        tuple(sorted(seen, key=lambda b: [p.name for p in problem.board_poses].index(b.pose))),
        _rms([b.error_mm for b in bars]),
        _rms([b.camera_rms_px for b in seen]),
        _rms([b.projector_rms_px for b in seen]),
        tuple(failed),
    )


def _without(problem: BundleProblem, bars: set[int], boards: set[int]) -> BundleProblem:
    """Return the problem without what was seen of some poses."""
    return replace(
        problem,
        board_points=tuple(p for p in problem.board_points if p.pose not in boards),
        bar_points=tuple(p for p in problem.bar_points if p.pose not in bars),
    )


def _alone(problem: BundleProblem, found: Adjustment, bars: set[int], boards: set[int]) -> BundleProblem:
    """Return the problem of some poses alone: sensors and boards as found, no tie of lengths."""
    known = {(n.what, n.artefact): n.value for n in found.nuisance}
    pitch = [known.get((Estimated.PITCH_SCALE, board.name), 1.0) for board in problem.boards]
    sensors = zip(problem.sensors, found.sensors, strict=True)
    points = [p for p in problem.board_points if p.pose in boards]
    return replace(
        problem,
        sensors=tuple(
            replace(
                old, intrinsics=new.intrinsics, pose=new.pose, fixed=SENSOR_PARAMETERS, fixed_aspect=False
            )
            for old, new in sensors
        ),
        boards=tuple(_as_found(board, known) for board in problem.boards),
        bars=tuple(replace(b, length_sigma_mm=0.0, repeatability_mm=np.inf) for b in problem.bars),
        board_points=tuple(
            replace(p, point=p.point * pitch[problem.board_poses[p.pose].board]) for p in points
        ),
        bar_points=tuple(p for p in problem.bar_points if p.pose in bars),
        world_board=None,
        prior=None,
    )


def _as_found(board: BundleBoard, known: Mapping[tuple[Estimated, str], float]) -> BundleBoard:
    """Return a board that keeps the shape that was found; its pitch is that of its points."""
    if not isinf(board.radius_mm):
        told = 2.0 * abs(board.radius_mm)
        found = known.get((Estimated.DIAMETER, board.name), told + board.shape_mm[0])
        return replace(
            board, pitch_relative_sigma=0.0, diameter_sigma_mm=0.0, shape_mm=(found - told, 0.0, 0.0)
        )
    terms = zip(SHAPE, board.shape_mm, strict=True)
    bow_x, bow_y, twist = (known.get((what, board.name), kept) for what, kept in terms)
    return replace(board, pitch_relative_sigma=0.0, flatness_mm=0.0, shape_mm=(bow_x, bow_y, twist))


def _lengths(problem: BundleProblem, measured: Adjustment, bars: set[int]) -> list[HeldOutBar]:
    found = []
    for k in sorted(bars):
        pose = problem.bar_poses[k]
        length = float(np.linalg.norm(measured.centres[k, 1] - measured.centres[k, 0]))
        observed = {int(n) for p in problem.bar_points if p.pose == k for n in np.unique(p.sphere)}
        if observed == {1, 2}:
            found.append(HeldOutBar(pose.name, length, length - problem.bars[pose.bar].length_mm))
    return found


def _reprojections(problem: BundleProblem, measured: Adjustment, boards: set[int]) -> list[HeldOutBoard]:
    rms = {(r.name, r.type): r.rms for r in measured.rms if r.of == "pose"}
    names = [problem.board_poses[k].name for k in sorted(boards)]
    return [
        HeldOutBoard(
            name,
            rms.get((name, ResidualType.BOARD_IN_CAMERA), float("nan")),
            rms.get((name, ResidualType.BOARD_IN_PROJECTOR), float("nan")),
        )
        for name in names
    ]


def _rms(values: list[float]) -> float:
    finite = [v for v in values if np.isfinite(v)]
    return float(np.sqrt(np.mean(np.square(finite)))) if finite else float("nan")
