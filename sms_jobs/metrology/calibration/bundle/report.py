"""What a bundle adjustment found, put in order for people: rms by type, sensor and pose, reasons, lengths."""

from __future__ import annotations

from dataclasses import dataclass
from math import isinf
from typing import Literal

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.bundle.normal_equations import Block, Live, Observed, Packed
from sms_jobs.metrology.calibration.bundle.parameters import Freedom, Layout, State, adjusted_sensor
from sms_jobs.metrology.calibration.bundle.problem import BundleOptions, BundleProblem, ResidualType
from sms_jobs.metrology.calibration.bundle.result import AdjustedSensor, Nuisance, Rms
from sms_jobs.metrology.calibration.bundle.weights import distances
from sms_jobs.metrology.calibration.estimates import Estimated
from sms_jobs.metrology.geometry.camera import Pose

Of = Literal["all", "sensor", "pair", "pose"]
Key = tuple[Of, str, ResidualType]


def adjusted_sensors(problem: BundleProblem, state: State) -> tuple[AdjustedSensor, ...]:
    """Return the sensors as they were found to be."""
    found = []
    for i, sensor in enumerate(problem.sensors):
        found.append(AdjustedSensor(sensor.name, *adjusted_sensor(sensor, state, i)))
    return tuple(found)


def board_poses(problem: BundleProblem, state: State) -> tuple[Pose, ...]:
    """Return the poses of the boards."""
    boards = range(len(problem.board_poses))
    return tuple(Pose.from_arrays(state.board[k, :, :3], state.board[k, :, 3]) for k in boards)


def nuisances(
    problem: BundleProblem, state: State, freedom: Freedom, covariance: Floats
) -> tuple[Nuisance, ...]:
    """Return the lengths, radii, pitch scales and shapes that were estimated along."""
    layout = Layout.of(problem)
    found = []

    def add(
        at: int,
        what: Estimated,
        artefact: str,
        prior: float,
        prior_sigma: float,
        value: float,
        sphere: int | None = None,
    ) -> None:
        if not freedom.free[at]:
            return
        sigma = float(np.sqrt(covariance[at, at]))
        # Where the rest tells nothing of a length it stays at its prior, and its z is 0 over 0.
        spread = max(prior_sigma**2 - sigma**2, 1e-6 * prior_sigma**2) ** 0.5
        z = (value - prior) / spread
        found.append(Nuisance(what, artefact, prior, prior_sigma, value, sigma, z, sphere))

    for k, bar in enumerate(problem.bars):
        at, radii = layout.bar(k), state.radii(problem, k)
        length = float(state.length[k])
        add(at, Estimated.LENGTH, bar.name, bar.length_mm, bar.length_sigma_mm, length)
        for i in (0, 1):
            radius, known = float(radii[i]), (bar.radius_mm, bar.radius_sigma_mm)
            add(at + 1 + i, Estimated.RADIUS, bar.name, *known, radius, i + 1)
    for k, board in enumerate(problem.boards):
        scale = state.pitch_scale(problem, k)
        at, shape = layout.board(k), state.shape(problem, k)
        add(at, Estimated.PITCH_SCALE, board.name, 1.0, board.pitch_relative_sigma, scale)
        told = 0.0 if isinf(board.radius_mm) else 2.0 * abs(board.radius_mm)
        for i, what in enumerate(board.shape_terms):
            add(at + 1 + i, what, board.name, told, board.shape_sigma_mm[i], told + float(shape[i]))
    return tuple(found)


@dataclass
class _Sum:
    square: float = 0.0
    whitened: float = 0.0
    count: int = 0
    rejected: int = 0


def rms_tables(
    problem: BundleProblem, packed: Packed, observed: Observed, in_mm: Floats, live: Live
) -> tuple[Rms, ...]:
    """Return rms by type for everything, by sensor, pair and pose; `in_mm` (n, 2) of points on spheres."""
    sums: dict[Key, _Sum] = {}

    def add(keys: list[tuple[Of, str]], kind: ResidualType, raw: Floats, white: Floats, used: Mask) -> None:
        for key in keys:
            total = sums.setdefault((*key, kind), _Sum())
            total.square += float(np.sum(raw[used] ** 2)) / raw.shape[1]
            total.whitened += float(np.sum(white[used] ** 2)) / raw.shape[1]
            total.count += int(used.sum())
            total.rejected += int((~used).sum())

    for block in packed.bars:
        part, keys = slice(block.start, block.stop), _keys(problem, block, bar=True)
        found, white, used = in_mm[part], observed.bar_found[part], live.bar[part]
        add(keys, ResidualType.RAY_GAP, found[:, 0:1], white[:, 0:1], used)
        add(keys, ResidualType.SPHERE_SURFACE, found[:, 1:2], white[:, 1:2], used)
    for block in packed.boards:
        part, keys = slice(block.start, block.stop), _keys(problem, block, bar=False)
        found, used = observed.board_found[part], live.board[part]
        add(keys, ResidualType.of_board_in(block.projector), found[:, 0:2], found[:, 2:4], used)
    return tuple(_row(key, total) for key, total in sums.items())


def _keys(problem: BundleProblem, block: Block, bar: bool) -> list[tuple[Of, str]]:
    """Return the name under which the rms of a block is reported."""
    names = [problem.sensors[s].name for s in block.sensors]
    if not bar:
        pose = problem.board_poses[block.pose].name
        return [("all", "all"), ("sensor", names[0]), ("pose", pose)]
    pair: list[tuple[Of, str]] = [("sensor", names[0]), ("sensor", names[1]), ("pair", names[0] + names[1])]
    return [("all", "all"), *pair, ("pose", problem.bar_poses[block.pose].name)]


def _row(key: Key, total: _Sum) -> Rms:
    many = max(total.count, 1)
    rms, whitened = (total.square / many) ** 0.5, (total.whitened / many) ** 0.5
    nothing = total.count == 0
    return Rms(
        *key,
        count=total.count,
        rejected=total.rejected,
        rms=np.nan if nothing else rms,
        whitened=np.nan if nothing else whitened,
    )


def refusals(
    packed: Packed, observed: Observed, live: Live, scale: Floats, options: BundleOptions
) -> dict[str, int]:
    """Return why observations were left out, and how many."""
    bar, board = distances(observed, packed, scale)
    none = ~np.isfinite(bar)
    with np.errstate(invalid="ignore"):
        grazing = ~none & ~(observed.bar_found[:, 2] > options.least_incidence)
        far = ~none & ~grazing & (bar > options.reject)
    board_none = ~np.isfinite(board)
    board_far = ~board_none & (board > options.reject)
    beyond = f"residual beyond {options.reject:g} sigma"
    counts = {
        "sphere point without a residual, or on a sphere with too few points": int(np.sum(none & ~live.bar)),
        "sphere point on a grazing ray": int(np.sum(grazing & ~live.bar)),
        f"sphere point with a {beyond}": int(np.sum(far & ~live.bar)),
        "board point without a residual": int(np.sum(board_none & ~live.board)),
        f"board point with a {beyond}": int(np.sum(board_far & ~live.board)),
    }
    rest = int((~live.bar).sum() + (~live.board).sum()) - sum(counts.values())
    counts["point of a pose with too few points, or near the limit"] = rest
    return {reason: count for reason, count in counts.items() if count}


Pairs = tuple[tuple[Mask, ...], tuple[Mask, ...]]
Residuals = tuple[tuple[Floats, ...], tuple[Floats, ...]]


def per_item(
    problem: BundleProblem, packed: Packed, observed: Observed, in_mm: Floats, live: Live
) -> tuple[Pairs, Residuals]:
    """Return which points were used, and the residuals of all, in the order in which they were given.

    Returns
    -------
    (of bar points, of board points) twice: flags, then residuals in mm and px, observed less predicted.
    """
    used_bar = tuple(live.bar[order] for order in packed.bar_order)
    off_bar = tuple(in_mm[order] for order in packed.bar_order)
    used_board, off_board = [], []
    for start, points in zip(packed.board_start, problem.board_points, strict=True):
        part = slice(start, start + len(points.point))
        used_board.append(live.board[part])
        off_board.append(-observed.board_found[part, :2])
    return (used_bar, tuple(used_board)), (off_bar, tuple(off_board))
