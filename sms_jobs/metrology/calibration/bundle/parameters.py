"""The parameters of a bundle adjustment: their order and names, which are free, and their values."""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign, isinf

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.bundle.problem import BundleProblem, BundleSensor
from sms_jobs.metrology.calibration.bundle.residuals import PER_BOARD
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR, POSE_PARAMETERS, SENSOR_PARAMETERS, Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import rotation_matrix
from sms_jobs.metrology.geometry.wrapped_sheets import in_space

Ints = NDArray[np.signedinteger]


@dataclass(frozen=True)
class Layout:
    """Where each parameter stands: sensors, board poses, spheres' centres, bars, boards, in this order.

    Attributes
    ----------
    sensors, board_poses, bar_poses, bars, boards
        How many there are.
    """

    sensors: int
    board_poses: int
    bar_poses: int
    bars: int
    boards: int

    @classmethod
    def of(cls, problem: BundleProblem) -> Layout:
        """Return the layout of a problem."""
        return cls(
            len(problem.sensors),
            len(problem.board_poses),
            len(problem.bar_poses),
            len(problem.bars),
            len(problem.boards),
        )

    def board_pose(self, pose: int) -> int:
        """Return the first of the 6 parameters of a board pose: rotation from the left, translation."""
        return PER_SENSOR * self.sensors + 6 * pose

    def centre(self, pose: int, sphere: int) -> int:
        """Return the first of the 3 parameters of the centre of sphere 0 or 1."""
        return self.board_pose(self.board_poses) + 6 * pose + 3 * sphere

    def bar(self, bar: int) -> int:
        """Return the length's place of a bar; the radii of spheres 1 and 2 follow."""
        return self.centre(self.bar_poses, 0) + 3 * bar

    def board(self, board: int) -> int:
        """Return the place of the scale of a board's pitch; its shape follows, see `BundleBoard.shape_mm`."""
        return self.bar(self.bars) + PER_BOARD * board

    @property
    def size(self) -> int:
        """Return the number of parameters."""
        return self.board(self.boards)


def parameter_names(problem: BundleProblem) -> tuple[str, ...]:
    """Return the name of every parameter, in the order of `Layout`."""
    names = [f"{s.name}.{p}" for s in problem.sensors for p in SENSOR_PARAMETERS]
    names += [f"board {b.name}.{p}" for b in problem.board_poses for p in POSE_PARAMETERS]
    names += [f"bar {b.name}.sphere{k}.{c}" for b in problem.bar_poses for k in (1, 2) for c in "xyz"]
    names += [f"{b.name}.{p}" for b in problem.bars for p in ("length", "radius1", "radius2")]
    for board in problem.boards:
        first = "bow-x" if isinf(board.radius_mm) else "diameter"
        names += [f"{board.name}.{p}" for p in ("pitch-scale", first, "bow-y", "twist")]
    return tuple(names)


@dataclass(frozen=True)
class Freedom:
    """Which parameters are estimated, and which follow another one.

    Attributes
    ----------
    free
        (parameters,) estimated on their own.
    followers
        (follower, leader, ratio): changes by ratio times the leader's change, and is not in `free`.
    """

    free: Mask
    followers: tuple[tuple[int, int, float], ...]

    def without(self, places: Ints) -> Freedom:
        """Return the freedom with some parameters kept as they are."""
        free = self.free.copy()
        free[places] = False
        return Freedom(free, self.followers)

    def fold(self, normal: Floats, gradient: Floats) -> tuple[Floats, Floats]:
        """Return the normal matrix and gradient of the free parameters alone."""
        if self.followers:
            normal, gradient = normal.copy(), gradient.copy()
        for follower, leader, ratio in self.followers:
            normal[leader] += ratio * normal[follower]
            normal[:, leader] += ratio * normal[:, follower]
            gradient[leader] += ratio * gradient[follower]
        at = np.flatnonzero(self.free)
        return np.ascontiguousarray(normal[np.ix_(at, at)]), gradient[at]

    def unfold(self, step: Floats) -> Floats:
        """Return the change of every parameter, of that of the free ones."""
        full = np.zeros(len(self.free))
        full[self.free] = step
        for follower, leader, ratio in self.followers:
            full[follower] = ratio * full[leader]
        return full

    def unfold_covariance(self, covariance: Floats) -> Floats:
        """Return the covariance of every parameter, 0 for fixed ones, of that of the free ones."""
        full = np.zeros((len(self.free), len(self.free)))
        full[np.ix_(self.free, self.free)] = covariance
        for follower, leader, ratio in self.followers:
            full[follower] = ratio * full[leader]
            full[:, follower] = ratio * full[:, leader]
        return full


def inner_parameters(problem: BundleProblem) -> Ints:
    """Return the places of all sensors' principal points and distortion, and of the shapes of boards."""
    first, layout = SENSOR_PARAMETERS.index("cx"), Layout.of(problem)
    places = np.arange(PER_SENSOR * layout.sensors).reshape(-1, PER_SENSOR)
    boards = np.arange(layout.board(0), layout.size).reshape(-1, PER_BOARD)
    return np.concatenate([places[:, first:].ravel(), boards[:, 1:].ravel()])


def freedom(problem: BundleProblem, seen_board: Mask, seen_sphere: Mask) -> Freedom:
    """Return what is estimated.

    Parameters
    ----------
    seen_board, seen_sphere
        (board poses,) and (bar poses, 2): whether enough points were seen for it to be estimated.
    """
    layout = Layout.of(problem)
    free = np.zeros(layout.size, np.bool_)
    followers = []
    for i, sensor in enumerate(problem.sensors):
        start = PER_SENSOR * i
        for k, name in enumerate(SENSOR_PARAMETERS):
            free[start + k] = name not in sensor.fixed
        focal = start + PER_POSE
        if sensor.fixed_aspect and free[focal]:
            free[focal + 1] = False
            followers.append((focal + 1, focal, sensor.intrinsics.fy / sensor.intrinsics.fx))
    if problem.world_board is None and problem.prior is None:
        free[:6] = False
    for pose in np.flatnonzero(seen_board):
        at = layout.board_pose(int(pose))
        free[at : at + 6] = pose != problem.world_board
    for pose, sphere in np.argwhere(seen_sphere):
        at, bar = layout.centre(int(pose), int(sphere)), problem.bar_poses[pose].bar
        free[at : at + 3] = True
        free[layout.bar(bar) + 1 + int(sphere)] = problem.bars[bar].radius_sigma_mm > 0.0
        if seen_sphere[pose].all():
            free[layout.bar(bar)] = problem.bars[bar].length_sigma_mm > 0.0
    for pose in np.flatnonzero(seen_board):
        number = problem.board_poses[pose].board
        at, board = layout.board(number), problem.boards[number]
        free[at] = board.pitch_relative_sigma > 0.0
        free[at + 1 : at + PER_BOARD] = np.array(board.shape_sigma_mm) > 0.0
    return Freedom(free, tuple(followers))


@dataclass
class State:
    """Values of all parameters.

    Attributes
    ----------
    rotation, translation, lens
        (s, 3, 3), (s, 3) and (s, parameters of a lens) of the sensors.
    board
        (board poses, 3, 6): rotation, translation, at [:, 0, 4] the scale of the board's pitch, at [:, 1, 4]
        the radius about which it is wrapped as told, 0 for a flat one, and at [:, :, 5] its shape.
    sphere
        (bar poses, 2, 4): centre and radius.
    length
        (bars,).
    """

    rotation: Floats
    translation: Floats
    lens: Floats
    board: Floats
    sphere: Floats
    length: Floats

    def moved(self, problem: BundleProblem, step: Floats) -> State:
        """Return the state after a change of all parameters, (parameters,)."""
        layout = Layout.of(problem)
        own = step[: PER_SENSOR * layout.sensors].reshape(-1, PER_SENSOR)
        poses = step[layout.board_pose(0) : layout.centre(0, 0)].reshape(-1, 6)
        board, sphere, length = self.board.copy(), self.sphere.copy(), self.length.copy()
        board[:, :, :3] = rotation_matrix(poses[:, :3]) @ board[:, :, :3]
        board[:, :, 3] += poses[:, 3:]
        for pose, placed in enumerate(problem.board_poses):
            at = layout.board(placed.board)
            board[pose, 0, 4] += step[at]
            board[pose, :, 5] += step[at + 1 : at + PER_BOARD]
        sphere[:, :, :3] = _turned_bars(
            sphere[:, :, :3], step[layout.centre(0, 0) : layout.bar(0)].reshape(-1, 2, 3)
        )
        for pose, held in enumerate(problem.bar_poses):
            at = layout.bar(held.bar)
            sphere[pose, :, 3] += step[at + 1 : at + 3]
        length += step[layout.bar(0) : layout.board(0)].reshape(-1, 3)[:, 0]
        return State(
            rotation_matrix(own[:, :3]) @ self.rotation,
            self.translation + own[:, 3:PER_POSE],
            self.lens + own[:, PER_POSE:],
            board,
            sphere,
            length,
        )

    def pitch_scale(self, problem: BundleProblem, board: int) -> float:
        """Return the scale of a board's pitch; 1 where no pose shows it."""
        for pose, placed in enumerate(problem.board_poses):
            if placed.board == board:
                return float(self.board[pose, 0, 4])
        return 1.0

    def shape(self, problem: BundleProblem, board: int) -> Floats:
        """Return the shape (3,) of a board in mm; that of the start where no pose shows it."""
        for pose, placed in enumerate(problem.board_poses):
            if placed.board == board:
                return self.board[pose, :, 5].copy()
        return np.array(problem.boards[board].shape_mm)

    def in_space(self, points: Floats, pose: int) -> Floats:
        """Return points of a board (n, 3) where they are in space, in the board's frame, but for its bow."""
        scaled = points * self.board[pose, 0, 4]
        told = float(self.board[pose, 1, 4])
        wider = float(self.board[pose, 0, 5])
        return in_space(scaled, told + copysign(0.5, told) * wider) if told else scaled

    def radii(self, problem: BundleProblem, bar: int) -> Floats:
        """Return the radii (2,) of the spheres of a bar, as certified where no pose shows it."""
        for pose, held in enumerate(problem.bar_poses):
            if held.bar == bar:
                return self.sphere[pose, :, 3].copy()
        return np.full(2, problem.bars[bar].radius_mm)


def _turned_bars(centres: Floats, step: Floats) -> Floats:
    """Return centres (poses, 2, 3) after a step: moved and turned by it, and as long as its first order says.

    A bar that turns would grow in the second order; tied to its length within half a micrometre, it could
    then take small steps only.
    """
    way = centres[:, 1] - centres[:, 0]
    moved = centres + step
    turned = moved[:, 1] - moved[:, 0]
    length = np.linalg.norm(way, axis=1)
    target_length = length + np.sum(way * (step[:, 1] - step[:, 0]), axis=1) / length
    half = 0.5 * turned * (target_length / np.linalg.norm(turned, axis=1))[:, None]
    middle = moved.mean(axis=1)
    both = np.stack([middle - half, middle + half], axis=1)
    # A bar of which one sphere was seen just moves.
    return np.where(np.isfinite(both), both, moved)


def sensor_arrays(sensors: tuple[tuple[Intrinsics, Pose], ...]) -> tuple[Floats, Floats, Floats]:
    """Return rotation (s, 3, 3), translation (s, 3) and lens (s, parameters of a lens) of sensors."""
    return (
        np.array([p.matrix() for _, p in sensors]),
        np.array([p.translation for _, p in sensors]),
        np.array([i.vector() for i, _ in sensors]),
    )


def starting_state(problem: BundleProblem) -> State:
    """Return the values that a problem starts from."""
    rotation, translation, lens = sensor_arrays(tuple((s.intrinsics, s.pose) for s in problem.sensors))
    board = np.zeros((len(problem.board_poses), 3, 6))
    for pose, placed in enumerate(problem.board_poses):
        board[pose, :, :3], board[pose, :, 3] = placed.pose.matrix(), placed.pose.translation
        told = problem.boards[placed.board]
        board[pose, 0, 4], board[pose, :, 5] = 1.0, told.shape_mm
        board[pose, 1, 4] = 0.0 if isinf(told.radius_mm) else told.radius_mm
    sphere = np.zeros((len(problem.bar_poses), 2, 4))
    for pose, held in enumerate(problem.bar_poses):
        sphere[pose, :, :3] = held.centres
        sphere[pose, :, 3] = problem.bars[held.bar].radius_mm
    length = np.array([b.length_mm for b in problem.bars])
    return State(rotation, translation, lens, board, sphere, length)


def adjusted_sensor(sensor: BundleSensor, state: State, at: int) -> tuple[Intrinsics, Pose]:
    """Return the inner parameters and the pose of the sensor at a place; untouched where all is fixed."""
    if len(set(sensor.fixed)) == PER_SENSOR:
        return sensor.intrinsics, sensor.pose
    pose = Pose.from_arrays(state.rotation[at], state.translation[at])
    return Intrinsics.from_vector(state.lens[at]), pose
