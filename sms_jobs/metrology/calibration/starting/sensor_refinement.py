"""Least squares for one sensor: its inner parameters and the poses of what it saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.sensor_derivatives import project_with_derivatives
from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.lens import LENS, PER_LENS, Intrinsics
from sms_jobs.metrology.geometry.transforms import rotation_matrix, transform

_MOST_ITERATIONS = 60
_CONVERGED = 1e-9  # relative change of the cost
_REFUSED_BEYOND = 6.0
_RAYLEIGH_MEDIAN = 1.1774
_STILL = Pose.from_arrays(np.eye(3), np.zeros(3))
_PLAUSIBLE = np.array([parameter.plausible for parameter in LENS.values()])


@dataclass(frozen=True)
class SeenPoints:
    """Points (n, 3) in mm of one rigid thing, their images (n, 2), and standard deviations (n,) in px."""

    point: Floats
    pixel: Floats
    sigma_px: Floats


@dataclass(frozen=True)
class RefinedSensor:
    """A sensor that fits what it saw.

    Attributes
    ----------
    intrinsics
        Inner parameters.
    poses
        Of each thing that was seen: x_sensor = R X + T.
    lens_sigma
        (parameters,) standard deviations of the inner parameters; 0 where fixed, infinite where undetermined.
    kept
        Of each thing, (n,) which points were used.
    residual
        Of each thing, (n, 2) in px, observed less predicted; NaN behind the sensor.
    scale
        Robust standard deviation of the residuals, in units of the stated one.
    cost
        Robust cost at the end.
    """

    intrinsics: Intrinsics
    poses: tuple[Pose, ...]
    lens_sigma: Floats
    kept: tuple[Mask, ...]
    residual: tuple[Floats, ...]
    scale: float
    cost: float


@dataclass
class _Problem:
    """All points of all things in one row, which is as quick as one thing alone."""

    seen: SeenPoints
    points: tuple[Floats, ...]  # of each thing
    ends: list[int]  # of the points of each thing but the last
    kept: Mask
    basis: Floats  # (parameters, free): lens parameters by free ones
    scale: float
    huber: float


def _inside(problem: _Problem, poses: Sequence[Pose]) -> tuple[Floats, Floats]:
    """Return R x + T and R x of every point, (n, 3) in mm."""
    own = list(zip(problem.points, poses, strict=True))
    inside = np.concatenate([transform(pose, points) for points, pose in own])
    offset = np.repeat([p.translation for p in poses], [len(points) for points in problem.points], axis=0)
    return inside, inside - offset


def _residuals(problem: _Problem, intrinsics: Intrinsics, poses: Sequence[Pose]) -> Floats:
    """Return observed less predicted pixels, (n, 2); NaN behind the sensor."""
    return problem.seen.pixel - project(intrinsics, _STILL, _inside(problem, poses)[0])


def _distances(problem: _Problem, intrinsics: Intrinsics, poses: Sequence[Pose]) -> Floats:
    """Return the length of the whitened residual of every point; infinite behind the sensor."""
    off = np.linalg.norm(_residuals(problem, intrinsics, poses), axis=1) / problem.seen.sigma_px
    return np.where(np.isfinite(off), off, np.inf)


def _huber_cost(problem: _Problem, intrinsics: Intrinsics, poses: Sequence[Pose]) -> float:
    bend = min(problem.huber, 1e150)  # squares of which are finite
    d = _distances(problem, intrinsics, poses)[problem.kept] / problem.scale
    total = float(np.sum(np.where(d <= bend, 0.5 * d * d, bend * (d - 0.5 * bend))))
    lens = intrinsics.vector()
    held = np.inf > _PLAUSIBLE
    return total + float(0.5 * np.sum((lens[held] / _PLAUSIBLE[held]) ** 2))


def _normal_equations(
    problem: _Problem, intrinsics: Intrinsics, poses: Sequence[Pose]
) -> tuple[Floats, Floats, list[tuple[Floats, Floats, Floats]]]:
    """Return the lens's block and gradient, and of each pose its block, the mixed block and its gradient."""
    prior = 1.0 / _PLAUSIBLE**2
    a = problem.basis.T @ (prior[:, None] * problem.basis)
    g = -problem.basis.T @ (prior * intrinsics.vector())
    kept = problem.kept
    inside, turned = _inside(problem, poses)
    pixels, by_pose, by_lens = project_with_derivatives(intrinsics, _STILL, inside[kept])
    # A point of a pose turns about that pose's origin, not about the pin-hole: g (r x p) = r (p x g).
    by_pose[:, :, :3] = np.cross(turned[kept, None], by_pose[:, :, 3:])
    weight = 1.0 / (problem.scale * problem.seen.sigma_px[kept])
    off = (problem.seen.pixel[kept] - pixels) * weight[:, None]
    distance = np.linalg.norm(off, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        robust = np.sqrt(np.where(distance > problem.huber, problem.huber / distance, 1.0))
    weight, off = weight * robust, (off * robust[:, None]).ravel()
    j_pose = (by_pose * weight[:, None, None]).reshape(-1, 6)
    j_lens = (by_lens * weight[:, None, None]).reshape(-1, PER_LENS) @ problem.basis
    blocks = []
    last = np.cumsum([int(part.sum()) for part in np.split(kept, problem.ends)])
    for begin, end in pairwise([0, *(2 * last)]):
        pose, lens, own = j_pose[begin:end], j_lens[begin:end], off[begin:end]
        blocks.append((pose.T @ pose, lens.T @ pose, pose.T @ own))
    return a + j_lens.T @ j_lens, g + j_lens.T @ off, blocks


def _reduced(
    a: Floats, g: Floats, blocks: list[tuple[Floats, Floats, Floats]], damping: float
) -> tuple[Floats, Floats, list[Floats]]:
    """Eliminate the poses: return Schur complement, right side, and the inverse of each pose's block."""
    s, right = a + damping * np.diag(np.diag(a)), g.copy()
    damped = np.stack([own for own, _, _ in blocks])
    diagonal = np.arange(damped.shape[1])
    damped[:, diagonal, diagonal] *= 1.0 + max(damping, 1e-13)
    inverses = list(np.asarray(np.linalg.inv(damped), dtype=np.float64))
    for (_, mixed, gradient), inverse in zip(blocks, inverses, strict=True):
        told = mixed @ inverse
        s -= told @ mixed.T
        right -= told @ gradient
    return s, right, inverses


def _moved(
    intrinsics: Intrinsics,
    poses: Sequence[Pose],
    basis: Floats,
    lens_step: Floats,
    pose_steps: Sequence[Floats],
) -> tuple[Intrinsics, list[Pose]]:
    changed = Intrinsics.from_vector(intrinsics.vector() + basis @ lens_step)
    turns = rotation_matrix(np.stack([s[:3] for s in pose_steps]))
    return changed, [
        Pose.from_arrays(turn @ p.matrix(), np.array(p.translation) + s[3:])
        for p, s, turn in zip(poses, pose_steps, turns, strict=True)
    ]


def _descend(
    problem: _Problem, intrinsics: Intrinsics, poses: list[Pose]
) -> tuple[Intrinsics, list[Pose], float]:
    """Levenberg-Marquardt from a start."""
    damping, cost = 1e-3, _huber_cost(problem, intrinsics, poses)
    for _ in range(_MOST_ITERATIONS):
        a, g, blocks = _normal_equations(problem, intrinsics, poses)
        while damping < 1e8:
            try:
                s, right, inverses = _reduced(a, g, blocks, damping)
                lens_step = np.asarray(np.linalg.solve(s, right), np.float64) if len(right) else right
            except np.linalg.LinAlgError:
                damping *= 10.0
                continue
            steps = [i @ (b[2] - b[1].T @ lens_step) for i, b in zip(inverses, blocks, strict=True)]
            tried = _moved(intrinsics, poses, problem.basis, lens_step, steps)
            changed = _huber_cost(problem, *tried)
            if changed <= cost and tried[0].fx > 0.0 and tried[0].fy > 0.0:
                break
            damping *= 10.0
        else:
            return intrinsics, poses, cost
        (intrinsics, poses), gain = tried, cost - changed
        cost, damping = changed, max(damping / 10.0, 1e-12)
        if gain <= _CONVERGED * cost:
            break
    return intrinsics, poses, cost


def _robust_scale(used: Floats) -> float:
    """Return the standard deviation that the median distance tells, in stated ones; never nothing."""
    return max(float(np.median(used)) / _RAYLEIGH_MEDIAN, 1e-6)


def refine_sensor(
    seen: Sequence[SeenPoints],
    intrinsics: Intrinsics,
    poses: Sequence[Pose],
    *,
    free: Sequence[str],
    square_pixels: bool = False,
    trusted: Sequence[Mask] | None = None,
    huber: float = 3.0,
    refuse: bool = True,
) -> RefinedSensor:
    """Fit the inner parameters of a sensor, and the poses of rigid things that it saw, to their images.

    Parameters
    ----------
    seen
        One item for each thing: a board in one pose, or points in the world.
    intrinsics, poses
        The start; the poses map each thing's frame to the sensor.
    free
        Names of `LENS` that are estimated; the others keep the values of the start.
    square_pixels
        Keep fy / fx at the ratio of the start.
    trusted
        Of each thing, (n,) the points to begin with; all by default.
    huber
        From how many robust standard deviations on a point pulls no harder; infinite for least squares.
    refuse
        In the end leave out those of all points, trusted or not, that are farther than 6 robust standard
        deviations from where they should be.

    Notes
    -----
    Levenberg-Marquardt on the Huber cost of the reprojection residuals (Zhang 2000, Eq. (14)), the poses
    eliminated by their Schur complement. The scale of the residuals is their own robust one, since before
    distortion is found they are larger than stated.
    """
    basis = np.eye(PER_LENS)[:, [list(LENS).index(name) for name in free]]
    if square_pixels and "fx" in free:
        basis[1] = basis[0] * intrinsics.fy / intrinsics.fx
        basis = basis[:, [name != "fy" for name in free]]
    placed = list(poses)
    problem = _posed(seen, basis, huber)
    problem.kept = np.isfinite(_distances(problem, intrinsics, placed))
    if trusted is not None:
        problem.kept &= np.concatenate(trusted)
    cost = 0.0
    for round_ in range(4):
        distances = _distances(problem, intrinsics, placed)
        problem.scale = _robust_scale(distances[problem.kept])
        if refuse and round_ > 1:
            problem.kept = distances <= _REFUSED_BEYOND * problem.scale
        intrinsics, placed, cost = _descend(problem, intrinsics, placed)
    a, g, blocks = _normal_equations(problem, intrinsics, placed)
    # Residuals below the stated deviations do not make the parameters better known than those say.
    covariance = _covariance(_reduced(a, g, blocks, 0.0)[0]) * max(1.0, 1.0 / problem.scale) ** 2
    lens_sigma = np.sqrt(np.maximum(np.sum((basis @ covariance) * basis, axis=1), 0.0))
    return RefinedSensor(
        intrinsics,
        tuple(placed),
        lens_sigma,
        tuple(np.split(problem.kept, problem.ends)),
        tuple(np.split(_residuals(problem, intrinsics, placed), problem.ends)),
        problem.scale,
        cost,
    )


def _posed(seen: Sequence[SeenPoints], basis: Floats, huber: float) -> _Problem:
    """Return the problem with all points of all things, and the deviations that are stated."""
    points, pixels, sigmas = zip(*((s.point, s.pixel, s.sigma_px) for s in seen), strict=True)
    together = SeenPoints(*(np.concatenate(part) for part in (points, pixels, sigmas)))
    ends = np.cumsum([len(part) for part in points])[:-1].tolist()
    return _Problem(together, points, ends, np.ones(len(together.point), bool), basis, 1.0, huber)


def _covariance(information: Floats) -> Floats:
    """Invert an information matrix; infinite in the diagonal where it tells nothing."""
    if not information.size:
        return information
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    floored = np.maximum(values, 1e-14)  # below it, rounding
    return np.asarray((vectors / floored) @ vectors.T / np.outer(scale, scale))
