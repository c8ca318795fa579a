"""Whether sensors see one board at one time, or images belong to other poses or to each other's sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sms_jobs.errors import CalibrationFailed
from sms_jobs.metrology.calibration.board_views import BoardView, Refusal
from sms_jobs.metrology.calibration.starting.sensor_start import SensorStart
from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.transforms import compose, inverse, transform

_FAR = 0.25
"""Of the size of a board's image, rms: farther off no first value of a lens puts it, another pose does."""

_FEWEST = 3
"""Shared poses from which a majority can tell which of them is wrong."""


def drop_unshared(starts: Mapping[str, SensorStart], views: Sequence[BoardView], world: str) -> list[Refusal]:
    """Take poses out in which two sensors contradict how most poses place one to the other; return them.

    Raises
    ------
    CalibrationFailed
        When no half of the poses that two sensors share agrees on how they stand to each other.
    """
    by_name = {(view.sensor, view.pose): view for view in views}
    refused = []
    names = list(starts)
    for number, first in enumerate(names):
        for other in names[number + 1 :]:
            shared = [pose for pose in starts[first].poses if pose in starts[other].poses]
            if len(shared) < _FEWEST:
                continue
            for pose in _contradicting(starts[first], starts[other], by_name, (first, other), shared):
                reason = (
                    f"{first} and {other} contradict here where all other poses place them: the images are "
                    "exchanged, or of different poses; import them anew"
                )
                for name in (first, other):
                    if pose == world and name == first:
                        continue
                    count = len(starts[name].kept[pose])
                    refused.append(Refusal(name, pose, count, reason, wrong=True))
                    for table in (starts[name].poses, starts[name].kept, starts[name].rms_px):
                        del table[pose]
    return refused


def _contradicting(
    first: SensorStart,
    other: SensorStart,
    views: Mapping[tuple[str, str], BoardView],
    names: tuple[str, str],
    shared: Sequence[str],
) -> list[str]:
    """Return the poses that do not agree with the motion from sensor to sensor that most agree with."""
    best: list[str] = []
    for candidate in shared:
        motion = compose(other.poses[candidate], inverse(first.poses[candidate]))
        agreeing = [pose for pose in shared if _near(motion, first.poses[pose], other, views[names[1], pose])]
        best = max(best, agreeing, key=len)
    if 2 * len(best) <= len(shared):
        raise CalibrationFailed(
            f"{names[0]} and {names[1]} do not see the board at one place in more than {len(best)} of "
            f"{len(shared)} poses: images of different poses are paired, or cameras are exchanged; check "
            "which image belongs to which pose and camera"
        )
    return [pose for pose in shared if pose not in best]


def _near(motion: Pose, placed: Pose, other: SensorStart, view: BoardView) -> bool:
    """Say whether a board that one sensor placed is about where another one sees it."""
    expected = project(other.intrinsics, motion, transform(placed, view.in_space))
    off = np.sqrt(np.mean((expected - view.pixel) ** 2))
    size = np.sqrt(np.mean(np.var(view.pixel, axis=0)))
    return bool(off < _FAR * size)  # not so where it lies behind the sensor, NaN
