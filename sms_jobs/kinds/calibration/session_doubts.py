"""What is doubtful about a calibration session before anything is adjusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sms_jobs.kinds.calibration.seen_boards import Boards
from sms_jobs.kinds.calibration.session_adjustment import Bars, Start, middle_centres
from sms_jobs.records.observations import BarObservation, BoardObservation

_FLAT = 0.02
"""Of the largest extent of all spheres, rms: what is less across a plane tells nothing of that direction."""


def alike_numbered(bars: Bars) -> tuple[Bars, tuple[str, ...]]:
    """Return observations in which all views number a pose's spheres alike, and a sentence for each changed.

    Each view's centres are compared with those of the first view that saw both spheres.
    """
    found: dict[str, list[BarObservation]] = {}
    warnings = []
    for pose, seen in bars.items():
        found[pose] = []
        first: BarObservation | None = None
        for one in seen:
            complete = bool(np.isfinite(one.centre).all())
            if first is not None and complete and _exchanged(first, one):
                warnings.append(
                    f"pose {pose}: {one.camera}{one.projector} numbers the spheres the other way round than "
                    f"{first.camera}{first.projector}; they were exchanged: look whether the pose is right"
                )
                one = replace(
                    one, sphere=3 - one.sphere, centre=one.centre[::-1], centre_sigma=one.centre_sigma[::-1]
                )
            elif first is None and complete:
                first = one
            found[pose].append(one)
    return found, tuple(warnings)


def _exchanged(first: BarObservation, other: BarObservation) -> bool:
    apart = np.linalg.norm(other.centre - first.centre)
    return bool(np.linalg.norm(other.centre[::-1] - first.centre) < apart)


def doubts_of(start: Start, boards: Boards, bars: Bars) -> tuple[str, ...]:
    """Return what a person has to look at: poses that nobody saw, bars that tell little."""
    shown = {pose for _, pose in start.usable}
    unseen = [pose for pose in boards if pose not in shown or pose not in start.boards]
    doubts = [f"pose {pose}: nobody saw enough of the board; {_why(start, boards, pose)}" for pose in unseen]
    doubts += [f"pose {pose}: {why}" for pose, why in start.wrong.items() if pose not in unseen]
    if not bars:
        return tuple(doubts)
    centres = {pose: middle_centres(seen) for pose, seen in bars.items()}
    doubts += [
        f"pose {pose}: nobody saw a sphere of the bar; record it again, or leave it out"
        for pose, both in centres.items()
        if not np.isfinite(both).any()
    ]
    if not any(np.isfinite(both).all() for both in centres.values()):
        doubts.append(
            "no pose shows both spheres of the bar, so that its length takes no part; record such poses"
        )
    return (*doubts, *_flat(np.concatenate(list(centres.values()))))


def _why(start: Start, boards: Boards, pose: str) -> str:
    """Say why no view of a pose shows the board, and what to do."""
    reasons = {reason: one.camera for one in boards[pose] if (reason := why_unseen(one))}
    for why in start.refused:
        sensor, _, reason = why.partition(f" in pose {pose}: ")
        if reason:
            reasons.setdefault(reason, sensor)
    if not reasons:
        return "record it again, or leave it out"
    return "; ".join(f"{camera}: {reason}" for reason, camera in reasons.items())


def why_unseen(seen: BoardObservation) -> str:
    """Say why a view has no point of a board; nothing where it has."""
    if len(seen.point):
        return ""
    if seen.reason:
        return seen.reason
    return "; ".join(f"{count} times {why}" for why, count in seen.refused.items())


def _flat(centres: np.ndarray) -> tuple[str, ...]:
    """Say so when all spheres lie on a line or in a plane."""
    finite = centres[np.isfinite(centres).all(axis=1)]
    if len(finite) < 2:
        return ()
    _, sizes, axes = np.linalg.svd(finite - finite.mean(axis=0), full_matrices=True)
    extent = np.pad(sizes, (0, 3 - len(sizes))) / np.sqrt(len(finite))
    if extent[2] > _FLAT * extent[0]:
        return ()
    line = extent[1] <= _FLAT * extent[0]
    named = ", ".join(f"{x:.2f}" for x in axes[0 if line else 2] + 0.0)
    what = f"one line along ({named})" if line else f"one plane with the normal ({named})"
    off = extent[1 if line else 2]
    doubt = (
        f"all spheres of the bar lie within {off:.2g} mm rms of {what}: its length tells nothing across it, "
        "nor do poses that are held out; add poses of the bar at other pan and tilt angles"
    )
    return (doubt,)
