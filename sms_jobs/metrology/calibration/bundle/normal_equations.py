"""Normal equations of a bundle adjustment: blocks of observations, ties and priors, summed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.calibration.board_shape import shape_terms
from sms_jobs.metrology.calibration.bundle.parameters import Layout, State, starting_state
from sms_jobs.metrology.calibration.bundle.problem import BundleOptions, BundleProblem
from sms_jobs.metrology.calibration.bundle.residuals import (
    BOARD_SIZE,
    PER_BOARD,
    SPHERE_SIZE,
    board_block,
    ray_distances,
    sphere_block,
)
from sms_jobs.metrology.compilation import in_row_blocks, kernel, uncounted_kernel
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR
from sms_jobs.metrology.geometry.transforms import rotation_vector

_LONGEST_BLOCK = 2048


@dataclass(frozen=True)
class Block:
    """Observations `start .. stop` of the arrays of their kind, which share their parameters.

    Attributes
    ----------
    item
        Place in the problem's `bar_points` or `board_points`.
    pose, sphere
        Sphere 0 or 1; 0 for a board.
    sensors
        Camera and projector, or the one sensor twice.
    projector
        For a board: whether the sensor is a projector.
    """

    item: int
    pose: int
    sphere: int
    sensors: tuple[int, int]
    projector: bool
    start: int
    stop: int


@dataclass(frozen=True)
class Packed:
    """Observations as kernels take them, sorted into blocks.

    Attributes
    ----------
    bars, boards
        Blocks of each kind.
    bar_observed, board_observed
        (n, 6) and (m, 9), see `sphere_block` and `board_block`.
    bar_order
        For each item of the problem's `bar_points` the place of its points in `bar_observed`, (n,).
    board_start
        For each item of `board_points` the place of its first point in `board_observed`.
    bar_index, board_index
        (blocks, SPHERE_SIZE) and (blocks, BOARD_SIZE): the parameters of each block.
    """

    bars: tuple[Block, ...]
    boards: tuple[Block, ...]
    bar_observed: Floats
    board_observed: Floats
    bar_order: tuple[Ints, ...]
    board_start: tuple[int, ...]
    bar_index: Ints
    board_index: Ints


def _run(start: int, count: int) -> Ints:
    return np.arange(start, start + count)


def pack(problem: BundleProblem) -> Packed:
    """Sort the observations of a problem into blocks."""
    layout = Layout.of(problem)
    bars, boards, order, begins = [], [], [], []
    bar_parts, board_parts = [np.empty((0, 6))], [np.empty((0, 9))]
    bar_index, board_index = [], []
    at = 0
    for item, seen in enumerate(problem.bar_points):
        place = np.empty(len(seen.sphere), np.int64)
        sigma = np.broadcast_to(seen.sigma_px.reshape(len(place), -1), seen.projector_px.shape)
        observed = np.column_stack([seen.camera_px, seen.projector_px, sigma]).astype(float)
        for sphere in (0, 1):
            chosen = np.flatnonzero(seen.sphere == sphere + 1)
            bar_parts.append(observed[chosen])
            place[chosen] = at + np.arange(len(chosen))
            index = np.concatenate(
                [
                    _run(PER_SENSOR * seen.camera, PER_SENSOR),
                    _run(PER_SENSOR * seen.projector, PER_SENSOR),
                    _run(layout.centre(seen.pose, sphere), 3),
                    [layout.bar(problem.bar_poses[seen.pose].bar) + 1 + sphere],
                ]
            )
            for start in range(at, at + len(chosen), _LONGEST_BLOCK):
                stop = min(start + _LONGEST_BLOCK, at + len(chosen))
                pair = (seen.camera, seen.projector)
                bars.append(Block(item, seen.pose, sphere, pair, False, start, stop))
                bar_index.append(index)
            at += len(chosen)
        order.append(place)
    at = 0
    for item, points in enumerate(problem.board_points):
        number = problem.board_poses[points.pose].board
        terms = shape_terms(points.point, problem.boards[number].outline_mm)
        board_parts.append(np.column_stack([points.point, terms, points.pixel, points.sigma_px]))
        begins.append(at)
        count, both = len(points.point), (points.sensor, points.sensor)
        index = np.concatenate(
            [
                _run(PER_SENSOR * points.sensor, PER_SENSOR),
                _run(layout.board_pose(points.pose), 6),
                _run(layout.board(number), PER_BOARD),
            ]
        )
        for start in range(at, at + count, _LONGEST_BLOCK):
            stop = min(start + _LONGEST_BLOCK, at + count)
            boards.append(Block(item, points.pose, 0, both, points.projector, start, stop))
            board_index.append(index)
        at += count
    return Packed(
        tuple(bars),
        tuple(boards),
        np.ascontiguousarray(np.concatenate(bar_parts)),
        np.ascontiguousarray(np.concatenate(board_parts)),
        tuple(order),
        tuple(begins),
        np.array(bar_index, np.int64).reshape(-1, SPHERE_SIZE),
        np.array(board_index, np.int64).reshape(-1, BOARD_SIZE),
    )


@dataclass
class Observed:
    """What is known of every observation at one state: see `sphere_block` and `board_block`."""

    board_whitening: Floats
    bar_found: Floats
    board_found: Floats

    @classmethod
    def empty(cls, packed: Packed) -> Observed:
        """Return room for the observations; the boards' first cost is 0."""
        n, m = len(packed.bar_observed), len(packed.board_observed)
        return cls(np.zeros((m, 3)), np.zeros((n, 4)), np.zeros((m, 5)))


@dataclass(frozen=True)
class Live:
    """Which observations take part, (n,) of bars and (m,) of boards."""

    bar: Mask
    board: Mask


@dataclass(frozen=True)
class Normal:
    """Normal equations at one state.

    Attributes
    ----------
    by_type
        (4, u, u) of each residual type, not divided by its variance factor.
    gradient
        (4, u) likewise.
    prior, prior_gradient, prior_cost
        Of ties and priors.
    old_cost
        Cost of the observations here with the whitening of the state before, for comparison with it.
    observed
        Residuals and whitening here.
    """

    by_type: Floats
    gradient: Floats
    prior: Floats
    prior_gradient: Floats
    prior_cost: float
    old_cost: float
    observed: Observed = field(repr=False)


@uncounted_kernel
def _scatter(
    local: Floats, vector: Floats, index: Ints, kinds: Ints, normal: Floats, gradient: Floats
) -> None:
    """Add the lower triangles of blocks (b, m, m) and vectors (b, m) at their parameters to their type."""
    for block in range(len(local)):
        kind = kinds[block]
        for i in range(local.shape[1]):
            row = index[block, i]
            gradient[kind, row] += vector[block, i]
            for j in range(i + 1):
                column = index[block, j]
                normal[kind, row, column] += local[block, i, j]
                if i != j:
                    normal[kind, column, row] += local[block, i, j]


def evaluate(
    problem: BundleProblem,
    packed: Packed,
    state: State,
    live: Live,
    scale: Floats,
    options: BundleOptions,
    before: Observed,
) -> Normal:
    """Return the normal equations at a state.

    Parameters
    ----------
    live
        The observations that take part.
    scale
        (4,) estimated over stated standard deviation of each residual type.
    before
        Of the state before, whose whitening of board points makes the cost comparable.
    """
    size = Layout.of(problem).size
    by_type, gradient = np.zeros((4, size, size)), np.zeros((4, size))
    now = Observed(
        before.board_whitening.copy(),
        np.empty_like(before.bar_found),
        np.empty_like(before.board_found),
    )
    local = np.zeros((len(packed.bars), 2, SPHERE_SIZE, SPHERE_SIZE))
    vector = np.zeros((len(packed.bars), 2, SPHERE_SIZE))
    costs = np.zeros(len(packed.bars))

    def spheres(first: int, last: int) -> None:
        for b in range(first, last):
            block = packed.bars[b]
            part = slice(block.start, block.stop)
            costs[b] = sphere_block(
                state.rotation,
                state.translation,
                state.lens,
                block.sensors,
                state.sphere[block.pose, block.sphere],
                packed.bar_observed[part],
                live.bar[part],
                scale[:2],
                options.huber,
                0.5 * options.least_incidence,
                now.bar_found[part],
                local[b],
                vector[b],
            )

    in_row_blocks(spheres, len(packed.bars), options.threads, block=8)
    for kind in (0, 1):
        kinds = np.full(len(packed.bars), kind)
        own = np.ascontiguousarray(local[:, kind]), np.ascontiguousarray(vector[:, kind])
        _scatter(*own, packed.bar_index, kinds, by_type, gradient)
    board_costs = _boards(problem, packed, state, live, scale, options, now, by_type, gradient)
    prior, prior_gradient, prior_cost = prior_equations(problem, state)
    cost = float(costs.sum() + board_costs.sum())
    return Normal(by_type, gradient, prior, prior_gradient, prior_cost, cost, now)


def _boards(
    problem: BundleProblem,
    packed: Packed,
    state: State,
    live: Live,
    scale: Floats,
    options: BundleOptions,
    now: Observed,
    by_type: Floats,
    gradient: Floats,
) -> Floats:
    """Add the board blocks; return their costs, (blocks,)."""
    local = np.zeros((len(packed.boards), BOARD_SIZE, BOARD_SIZE))
    vector, costs = np.zeros((len(packed.boards), BOARD_SIZE)), np.zeros(len(packed.boards))

    def boards(first: int, last: int) -> None:
        for b in range(first, last):
            block = packed.boards[b]
            part = slice(block.start, block.stop)
            costs[b] = board_block(
                state.rotation[block.sensors[0]],
                state.translation[block.sensors[0]],
                state.lens[block.sensors[0]],
                state.board[block.pose],
                packed.board_observed[part],
                live.board[part],
                problem.boards[problem.board_poses[block.pose].board].point_sigma_mm,
                float(scale[3 if block.projector else 2]),
                options.huber,
                now.board_whitening[part],
                now.board_found[part],
                local[b],
                vector[b],
            )

    in_row_blocks(boards, len(packed.boards), options.threads, block=8)
    kinds = np.array([3 if block.projector else 2 for block in packed.boards], np.int64)
    _scatter(local, vector, packed.board_index, kinds, by_type, gradient)
    return costs


def prior_equations(problem: BundleProblem, state: State) -> tuple[Floats, Floats, float]:
    """Return normal matrix, gradient and cost of the ties of bar lengths and of everything known beforehand.

    For each bar pose |S2 - S1| - length = 0 within the repeatability; length, radii, pitch scale and
    the shape of boards within their own standard deviations; the sensors by the prior's information matrix.
    """
    layout = Layout.of(problem)
    normal, gradient = np.zeros((layout.size, layout.size)), np.zeros(layout.size)
    cost = 0.0

    def add_prior(at: int, off: float, sigma: float) -> float:
        if not sigma > 0.0:
            return 0.0
        normal[at, at] += sigma**-2
        gradient[at] += off * sigma**-2
        return 0.5 * (off / sigma) ** 2

    for k, bar in enumerate(problem.bars):
        at, radii = layout.bar(k), state.radii(problem, k)
        cost += add_prior(at, float(state.length[k]) - bar.length_mm, bar.length_sigma_mm)
        for sphere in (0, 1):
            cost += add_prior(at + 1 + sphere, float(radii[sphere]) - bar.radius_mm, bar.radius_sigma_mm)
    for k, board in enumerate(problem.boards):
        at = layout.board(k)
        cost += add_prior(at, state.pitch_scale(problem, k) - 1.0, board.pitch_relative_sigma)
        for term, height in enumerate(state.shape(problem, k)):
            cost += add_prior(at + 1 + term, float(height), board.shape_sigma_mm[term])
    for pose, held in enumerate(problem.bar_poses):
        way = state.sphere[pose, 1, :3] - state.sphere[pose, 0, :3]
        apart = float(np.linalg.norm(way))
        repeat = problem.bars[held.bar].repeatability_mm
        if not (np.isfinite(apart) and np.isfinite(repeat)):
            continue
        index = np.append(_run(layout.centre(pose, 0), 6), layout.bar(held.bar))
        row = np.concatenate([-way / apart, way / apart, [-1.0]]) / repeat
        off = (apart - float(state.length[held.bar])) / repeat
        normal[np.ix_(index, index)] += np.outer(row, row)
        gradient[index] += row * off
        cost += 0.5 * off * off
    if problem.prior is not None:
        cost += _sensor_prior(problem, problem.prior.information, state, normal, gradient)
    return normal, gradient, cost


def _sensor_prior(
    problem: BundleProblem, information: Floats, state: State, normal: Floats, gradient: Floats
) -> float:
    """Add the prior of the sensors; return its cost."""
    start = starting_state(problem)
    off, slope = np.zeros(len(information)), np.eye(len(information))
    for i in range(len(problem.sensors)):
        at = PER_SENSOR * i
        turned = rotation_vector(state.rotation[i] @ start.rotation[i].T)
        off[at : at + 3] = turned
        slope[at : at + 3, at : at + 3] = _inverse_left_jacobian(turned)
        off[at + 3 : at + PER_POSE] = state.translation[i] - start.translation[i]
        off[at + PER_POSE : at + PER_SENSOR] = state.lens[i] - start.lens[i]
    pull = information @ off
    n = len(information)
    normal[:n, :n] += slope.T @ information @ slope
    gradient[:n] += slope.T @ pull
    return float(0.5 * off @ pull)


def _inverse_left_jacobian(vector: Floats) -> Floats:
    """Return d log(exp([r]x) exp([v]x)) / dr at r = 0, (3, 3), for a rotation vector v."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-4:
        second = 1.0 / 12.0
    else:
        second = 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    return np.asarray(np.eye(3) - 0.5 * across + second * across @ across)


@kernel
def _distances(
    rotation: Floats,
    translation: Floats,
    lens: Floats,
    pair: tuple[int, int],
    sphere: Floats,
    observed: Floats,
    found: Floats,
) -> None:
    """Fill found (n, 2) with ray gaps and distances to the sphere, in mm, of the points of a block."""
    for i in range(len(observed)):
        pixels = observed[i, :4].copy().reshape((2, 2))
        found[i, 0], found[i, 1] = ray_distances(rotation, translation, lens, pair, pixels, sphere)


def object_residuals(packed: Packed, state: State) -> Floats:
    """Return ray gap and sphere surface residual of all points on spheres, (n, 2) in mm."""
    found = np.empty((len(packed.bar_observed), 2))
    for block in packed.bars:
        part = slice(block.start, block.stop)
        _distances(
            state.rotation,
            state.translation,
            state.lens,
            block.sensors,
            state.sphere[block.pose, block.sphere],
            packed.bar_observed[part],
            found[part],
        )
    return found


def type_scale(by_type: Floats, scale: Floats) -> Floats:
    """Return by_type (4, ...) divided by the squares of the variance factors (4,) and summed."""
    return np.asarray(sum(own / factor**2 for own, factor in zip(by_type, scale, strict=True)))
