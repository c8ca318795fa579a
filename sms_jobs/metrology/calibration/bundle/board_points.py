"""The points of boards as an adjustment sees them: what their places do to it, and whether they are as told.

A board is printed once: where a point is off, it is off in every pose, and no number of poses averages it
away. So the points are looked at as if they were parameters too, each with three coordinates in its board's
frame, which one further step of Newton's method would free (Luhmann et al. 2019, section 4.4.2, call it a
test-field calibration).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isinf

import numpy as np
from scipy.special import chdtri

from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.calibration.bundle.normal_equations import Block, Observed, Packed
from sms_jobs.metrology.calibration.bundle.parameters import Freedom, Layout, State, parameter_names
from sms_jobs.metrology.calibration.bundle.problem import BundleProblem
from sms_jobs.metrology.calibration.bundle.residuals import BOARD_SIZE, board_rows
from sms_jobs.metrology.compilation import kernel

_MOST_GROUPS = 500
"""Points that are looked at one by one; of boards with more, neighbours share what they are off by."""

_SAME_MM = 1e-6
_CHANCE = 1e-6
"""Of warning of a board that is as told: one in a million."""
_FEWEST_VIEWS = 3
_HUBER = 3.0
_ROUNDS = 8
_NAMED = 5
_ABSORBED = 1e-7  # of the largest eigenvalue: directions that poses, scale and shape take up themselves


@kernel
def _derivatives(
    rotation: Floats,
    translation: Floats,
    lens: Floats,
    board: Floats,
    observed: Floats,
    rows: Floats,
    by_place: Floats,
) -> None:
    """Fill rows (n, 2, parameters) and by_place (n, 2, 3), derivatives of pixels by places in mm."""
    pixel, slope = np.empty(2), np.empty((2, 3))
    for n in range(len(observed)):
        if not board_rows(rotation, translation, lens, board, observed[n, :6], pixel, rows[n], slope):
            rows[n], by_place[n] = 0.0, 0.0
            continue
        for i in range(2):
            for k in range(3):
                total = 0.0
                for j in range(3):
                    total += slope[i, j] * board[j, k]
                by_place[n, i, k] = total


@dataclass(frozen=True)
class PointEquations:
    """Normal equations of the points of all boards, beside those of the parameters.

    Attributes
    ----------
    board
        (n,) number of each point's board.
    place
        (n, 3) in mm, on its board, as told.
    group
        (n,) which points share what they are off by.
    mixed
        (parameters, 3 groups), J^T W J_point.
    own
        (groups, 3, 3), J_point^T W J_point.
    pull
        (groups, 3), J_point^T W residual: which way the observations would have the points go.
    whitened
        Of every observation its point (m,), derivatives (m, 2, 3) and residual (m, 2), observed less
        predicted, in standard deviations.
    """

    board: Ints
    place: Floats
    group: Ints
    mixed: Floats
    own: Floats
    pull: Floats
    whitened: tuple[Ints, Floats, Floats]


def _points(problem: BundleProblem, packed: Packed) -> tuple[Ints, Floats, Ints, Ints]:
    """Return board (n,) and place (n, 3) of each point, its group, and the point (m,) of each observation."""
    number = np.zeros(len(packed.board_observed), np.int64)
    for block in packed.boards:
        number[block.start : block.stop] = problem.board_poses[block.pose].board
    keys = np.column_stack([number, np.rint(packed.board_observed[:, :2] / _SAME_MM).astype(np.int64)])
    _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    board, place = number[first], packed.board_observed[first, :3]
    groups = np.arange(len(first))
    if len(first) > _MOST_GROUPS:
        size = np.sqrt(len(first) / _MOST_GROUPS)
        cells = [board]
        for k in (0, 1):
            step = np.median(np.diff(np.unique(np.rint(place[:, k] / _SAME_MM)))) * _SAME_MM
            cells.append(np.floor(place[:, k] / (np.ceil(size) * step)).astype(np.int64))
        _, groups = np.unique(np.column_stack(cells), axis=0, return_inverse=True)
    return board, place, groups.reshape(-1).astype(np.int64), which.reshape(-1).astype(np.int64)


def point_equations(
    problem: BundleProblem, packed: Packed, state: State, observed: Observed, scale: Floats
) -> PointEquations | None:
    """Return the equations of all boards' points where an adjustment stands; None without boards.

    Parameters
    ----------
    observed
        With the weights that the adjustment gave; those that it left out weigh nothing.
    scale
        (4,) estimated over stated standard deviation of each residual type.
    """
    if not packed.boards:
        return None
    board, place, group, which = _points(problem, packed)
    count = int(group.max()) + 1
    mixed, own = np.zeros((Layout.of(problem).size, 3 * count)), np.zeros((count, 3, 3))
    pull = np.zeros((count, 3))
    slopes, residuals = np.zeros((len(which), 2, 3)), np.zeros((len(which), 2))
    for block, index in zip(packed.boards, packed.board_index, strict=True):
        part = slice(block.start, block.stop)
        rows, by_place, off = _whitened(packed, state, observed, block, float(scale[2 + block.projector]))
        weight = observed.board_found[part, 4]
        at = group[which[part]]
        mixed_here = np.einsum("n,nia,nik->nka", weight, rows, by_place)
        for k in range(3):
            np.add.at(mixed, (index[None, :], 3 * at[:, None] + k), mixed_here[:, k])
        np.add.at(own, at, np.einsum("n,nij,nik->njk", weight, by_place, by_place))
        np.add.at(pull, at, np.einsum("n,nij,ni->nj", weight, by_place, off))
        slopes[part], residuals[part] = by_place, off
    return PointEquations(board, place, group, mixed, own, pull, (which, slopes, residuals))


def _whitened(
    packed: Packed, state: State, observed: Observed, block: Block, scale: float
) -> tuple[Floats, Floats, Floats]:
    """Return derivatives (n, 2, parameters) and (n, 2, 3) and residuals (n, 2) of a block, whitened."""
    part, sensor = slice(block.start, block.stop), block.sensors[0]
    n = block.stop - block.start
    rows, by_place = np.zeros((n, 2, BOARD_SIZE)), np.zeros((n, 2, 3))
    _derivatives(
        state.rotation[sensor],
        state.translation[sensor],
        state.lens[sensor],
        state.board[block.pose],
        packed.board_observed[part],
        rows,
        by_place,
    )
    a, b, c = (observed.board_whitening[part] / scale).T
    both = []
    for table in (rows, by_place):
        first = a[:, None] * table[:, 0]
        both.append(np.stack([first, b[:, None] * table[:, 0] + c[:, None] * table[:, 1]], axis=1))
    off = -np.nan_to_num(observed.board_found[part, 2:4]) / scale
    return both[0], both[1], off


def _sigma(problem: BundleProblem, equations: PointEquations) -> Floats:
    """Return the standard deviation (3 groups,) in mm of what each group is off by, as told."""
    stated = np.array([board.point_sigma_mm for board in problem.boards])
    shared = np.bincount(equations.group)
    of_board = np.zeros(len(shared))
    of_board[equations.group] = stated[equations.board]
    return np.repeat(of_board / np.sqrt(shared), 3)


def _moved_by(equations: PointEquations, freedom: Freedom, covariance: Floats) -> Floats:
    """Return how the free parameters (u,) go with the points' places, (u, 3 groups), per mm."""
    mixed = equations.mixed
    for follower, leader, ratio in freedom.followers:
        mixed = mixed.copy()
        mixed[leader] += ratio * mixed[follower]
    return np.asarray(covariance @ mixed[freedom.free])


def placement_covariance(
    problem: BundleProblem, equations: PointEquations, freedom: Freedom, covariance: Floats
) -> Floats:
    """Return what the places of boards' points, as well as they are told, add to a covariance (u, u).

    Parameters
    ----------
    covariance
        (u, u) of the free parameters for points that are where they are told to be.
    """
    moved = _moved_by(equations, freedom, covariance) * _sigma(problem, equations)
    return np.asarray(moved @ moved.T)


@dataclass(frozen=True)
class PointsFound:
    """Whether the points of boards are where they are told to be, but for scale, bow and twist.

    Attributes
    ----------
    rms_mm
        Standard deviation of a point's place in each direction, as the observations have it; 0 where noise
        explains what they leave over.
    warnings
        What speaks against the boards.
    """

    rms_mm: float
    warnings: tuple[str, ...]


def judge_points(
    problem: BundleProblem, equations: PointEquations, freedom: Freedom, covariance: Floats
) -> PointsFound:
    """Ask of all poses together whether the points of the boards are where they are told to be.

    With A, B, D the parts of the normal matrix of parameters and points, what points are off by has the
    information S = D - B^T A^-1 B and the gradient g. In the directions v of its eigenvalues s,
    (v g)^2 / (s + s^2 sigma^2) are squares of standard normal numbers where points are off by their stated
    sigma. Where their sum is beyond chance, sigma is raised until it is not, and the points are freed with
    that: a calibration that would move by more than its deviations is warned of.
    """
    moved = _moved_by(equations, freedom, covariance)
    size = 3 * len(equations.own)
    information = -equations.mixed[freedom.free].T @ moved
    for group, own in enumerate(equations.own):
        at = slice(3 * group, 3 * group + 3)
        information[at, at] += own
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    told = values > _ABSORBED * values[-1]
    values, vectors = values[told], vectors[:, told]
    along = vectors.T @ equations.pull.reshape(size)
    stated = _sigma(problem, equations)
    within = np.sum((vectors * stated[:, None]) ** 2, axis=0)

    def excess(raised: float) -> float:
        return float(np.sum(along**2 / (values + values**2 * (within + raised)))) - len(values)

    named = _misplaced(problem, equations)
    if excess(0.0) + len(values) <= chdtri(len(values), _CHANCE):
        return PointsFound(0.0, named)
    raised = _root(excess)
    off = vectors @ (along / (values + 1.0 / (within + raised)))
    shift = -moved @ off
    deviation = np.sqrt(np.diag(covariance) + np.sum((moved * stated) ** 2, axis=1))
    sensors = np.flatnonzero(freedom.free) < Layout.of(problem).board_pose(0)
    return PointsFound(
        float(np.sqrt(raised)),
        (*named, *_shape_warning(problem, equations, freedom, off, np.where(sensors, shift, 0.0), deviation)),
    )


def _root(excess: Callable[[float], float]) -> float:
    """Return the variance in mm^2 at which a falling function is 0, to a hundredth."""
    low, high = 1e-14, 1e-8
    while excess(high) > 0.0 and high < 1e4:
        low, high = high, 10.0 * high
    while high > 1.01 * low:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return high


def _shape_warning(
    problem: BundleProblem,
    equations: PointEquations,
    freedom: Freedom,
    off: Floats,
    shift: Floats,
    deviation: Floats,
) -> tuple[str, ...]:
    """Warn of points whose places would move a calibration by more than its deviations."""
    worst = int(np.argmax(np.abs(shift) / deviation))
    if abs(shift[worst]) <= deviation[worst]:
        return ()
    by_group = off.reshape(-1, 3)
    far = np.linalg.norm(by_group, axis=1)[equations.group]
    point = int(np.argmax(far))
    name = [n for n, free in zip(parameter_names(problem), freedom.free, strict=True) if free][worst]
    board = problem.boards[equations.board[point]]
    flat = isinf(board.radius_mm)
    x, y = equations.place[point, :2]
    dx, dy, dz = by_group[equations.group[point]]
    rms = float(np.sqrt(np.mean(by_group**2)))
    told = (
        f"the points of {board.name} are not where they are told to be, nor does "
        f"{'bow or twist' if flat else 'a diameter within what is stated'} explain it: they "
        f"are off by {1e3 * rms:.3g} um rms in each direction, that at x {x:.4g}, y {y:.4g} mm by "
        f"({1e3 * dx:.0f}, {1e3 * dy:.0f}, {1e3 * dz:.0f}) um; with points set free {name} would go by "
        f"{shift[worst]:+.3g}, {abs(shift[worst]) / deviation[worst]:.1f} of its deviations (limit 1): is "
        + (
            "the board dented, or its print crooked? Take a flat one"
            if flat
            else "the cylinder out of round, or its print crooked? Take another one"
        )
    )
    return (told,)


def _misplaced(problem: BundleProblem, equations: PointEquations) -> tuple[str, ...]:
    """Name points that most poses see in another place than the rest of the board puts them."""
    which, slopes, residuals = equations.whitened
    count = len(equations.board)
    off, views = np.zeros((count, 3)), np.bincount(which, minlength=count)
    for _ in range(_ROUNDS):
        left = residuals - np.einsum("nij,nj->ni", slopes, off[which])
        distance = np.hypot(left[:, 0], left[:, 1])
        weight = np.minimum(1.0, _HUBER / np.maximum(distance, 1e-12))
        own, pull = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(own, which, np.einsum("n,nij,nik->njk", weight, slopes, slopes))
        np.add.at(pull, which, np.einsum("n,nij,ni->nj", weight, slopes, residuals))
        own += 1e-9 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-30 * np.eye(3)
        off = np.asarray(np.linalg.solve(own, pull[:, :, None])[:, :, 0], dtype=np.float64)
    stated = np.array([board.point_sigma_mm for board in problem.boards])[equations.board]
    spread = np.linalg.inv(own) + (stated**2)[:, None, None] * np.eye(3)
    squares = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[:, :, None])[:, :, 0])
    # A board whose shape is wrong as a whole has no single points to name: each is judged beside the others.
    usual = max(1.0, float(np.median(squares)) / chdtri(3, 0.5))
    loud = np.flatnonzero((squares / usual > chdtri(3, _CHANCE / count)) & (views >= _FEWEST_VIEWS))
    order = loud[np.argsort(-squares[loud])]
    found = [
        f"the point at x {equations.place[k, 0]:.4g}, y {equations.place[k, 1]:.4g} mm of "
        f"{problem.boards[equations.board[k]].name} lies {1e3 * np.linalg.norm(off[k]):.0f} um from where it "
        f"is told to be, in {views[k]} views (chi-square {squares[k] / usual:.0f}, 3 expected): cover it, or "
        "leave it out"
        for k in order[:_NAMED]
    ]
    if len(order) > _NAMED:
        found.append(f"{len(order) - _NAMED} more points of boards lie where they are not told to be")
    return tuple(found)
