"""What sensors saw of the boards of a session, and what is told of these boards, for an adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from sms_jobs.kinds.calibration.sessions import SessionPlan
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.board_views import BoardView
from sms_jobs.metrology.calibration.bundle.problem import BundleBoard
from sms_jobs.metrology.targets.patterns import radius_of
from sms_jobs.records.artefacts import Artefact, BallBar, DotCylinder, bow_sigma_mm, diameter_sigma_mm
from sms_jobs.records.observations import BoardObservation

Boards = Mapping[str, Sequence[BoardObservation]]
"""What views observed of a board, by pose."""

_UNKNOWN_PITCH = 0.01  # relative: what a bar is left to tell of a pitch that nobody has stated


def board_views(plan: SessionPlan, boards: Boards) -> list[BoardView]:
    """Return what every sensor saw of the board in each pose; what several views saw of it is averaged."""
    radius = {name: _radius_of(artefact) for name, artefact in plan.session.artefacts.items()}
    views = []
    for pose, observations in boards.items():
        seen: dict[str, list[tuple[BoardObservation, Floats, Floats]]] = {}
        for one in observations:
            if len(one.point):
                seen.setdefault(one.camera, []).append((one, one.camera_px, one.camera_sigma_px))
                if one.projector:
                    seen.setdefault(one.projector, []).append((one, one.projector_px, one.projector_sigma_px))
        views += [_averaged(sensor, pose, parts, radius) for sensor, parts in seen.items()]
    return views


def _radius_of(artefact: Artefact) -> float:
    """Return the radius about which an artefact's sheet of points is wrapped."""
    return radius_of(artefact) if isinstance(artefact, DotCylinder) else inf


def _averaged(
    sensor: str,
    pose: str,
    parts: Sequence[tuple[BoardObservation, Floats, Floats]],
    radius: Mapping[str, float],
) -> BoardView:
    place = np.concatenate([one.place for one, _, _ in parts])
    point = np.concatenate([one.point for one, _, _ in parts])
    pixel = np.concatenate([p for _, p, _ in parts])
    weight = 1.0 / np.concatenate([s for _, _, s in parts]) ** 2
    _, first, which = np.unique(place, axis=0, return_index=True, return_inverse=True)
    which = which.reshape(-1)
    total = np.bincount(which, weight)
    mean = np.stack([np.bincount(which, weight * pixel[:, k]) / total for k in (0, 1)], axis=-1)
    return BoardView(sensor, pose, point[first], mean, 1.0 / np.sqrt(total), radius[parts[0][0].artefact])


def told_board(
    plan: SessionPlan,
    name: str,
    pitch: tuple[float, float] | None,
    views: Sequence[BoardView],
    with_bar: bool,
) -> BundleBoard:
    """Return a board as it is told; a pitch that nobody has stated is nominal unless a bar can tell it.

    `pitch` is its scale with its relative standard deviation, where it was found before.
    """
    board = plan.session.artefacts[name]
    assert not isinstance(board, BallBar)
    scale, relative = pitch or (1.0, board.pitch_relative_sigma)
    if relative is None:
        relative = _UNKNOWN_PITCH if with_bar else 0.0
    shown = {p.label for p in plan.poses if p.artefact == name}
    points = scale * np.concatenate([np.empty((0, 3)), *(v.point for v in views if v.pose in shown)])
    if not len(points):
        return BundleBoard(name, relative, board.point_sigma_mm)
    if isinstance(board, DotCylinder):
        sigma = diameter_sigma_mm(board)
        return BundleBoard(
            name, relative, board.point_sigma_mm, radius_mm=radius_of(board), diameter_sigma_mm=sigma
        )
    (low_x, low_y, _), (high_x, high_y, _) = points.min(axis=0), points.max(axis=0)
    return BundleBoard(
        name,
        relative,
        board.point_sigma_mm,
        bow_sigma_mm(board),
        ((float(low_x), float(high_x)), (float(low_y), float(high_y))),
    )
