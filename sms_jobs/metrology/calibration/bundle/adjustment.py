"""Bundle adjustment in object space, over all sensors and all poses in one problem (thesis section 2.4.3).

Levenberg-Marquardt on normal equations that are summed block by block. Ray gap and sphere surface of a point
are functions of the same two noisy coordinates in the projector. Squared as millimetres they pull the whole
scene together, for a smaller one has smaller gaps: with a hundred thousand points that outweighs a board's
pitch. So each pair is taken in units of the noise that made it: the way that the projector's pixel would have
to go for the gap to close and for the point to lie on its sphere, over its standard deviation. On top of it
each residual type has a variance factor that its own residuals tell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sms_jobs.errors import CalibrationFailed
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.bundle.board_points import (
    PointsFound,
    judge_points,
    placement_covariance,
    point_equations,
)
from sms_jobs.metrology.calibration.bundle.changed_lenses import changed_lenses
from sms_jobs.metrology.calibration.bundle.checks import (
    check_before,
    check_counts,
    check_determined,
    pose_warnings,
    prior_warnings,
    weakest_in_words,
)
from sms_jobs.metrology.calibration.bundle.lens_signature import missing_radial
from sms_jobs.metrology.calibration.bundle.normal_equations import (
    Live,
    Normal,
    Observed,
    Packed,
    evaluate,
    object_residuals,
    pack,
    type_scale,
)
from sms_jobs.metrology.calibration.bundle.parameters import (
    Freedom,
    State,
    freedom,
    inner_parameters,
    parameter_names,
    starting_state,
)
from sms_jobs.metrology.calibration.bundle.problem import BundleOptions, BundleProblem, ResidualType
from sms_jobs.metrology.calibration.bundle.report import (
    adjusted_sensors,
    board_poses,
    nuisances,
    per_item,
    refusals,
    rms_tables,
)
from sms_jobs.metrology.calibration.bundle.result import Adjustment
from sms_jobs.metrology.calibration.bundle.weights import (
    Consistency,
    cost,
    distances,
    estimate_scale,
    first_scale,
)
from sms_jobs.metrology.small_systems import inverse, solve

_FEWEST_ON_SPHERE = 12
_FEWEST_ON_BOARD = 6
_ROUNDS = 4  # of leaving out and adjusting again; the second seldom changes anything
_COARSE = 1e-2  # with principal points and distortion as they start: far off, they would run away
_ROUGH = 1e-4  # relative cost at which it is worth looking for what to leave out
_GOOD_ENOUGH = 1e-7  # when the iterations are used up: of a cost of 10 000, 0.05 standard deviations
_LEAST_DAMPING = 1e-9
_MOST_DAMPING = 1e6
_SCALE_TOLERANCE = 1e-3  # relative change of variance factors: a tenth of what 50 000 residuals tell of them


@dataclass
class _Fit:
    """Where an adjustment stands."""

    state: State
    live: Live
    freedom: Freedom
    scale: Floats
    normal: Normal
    iterations: int = 0


def adjust(problem: BundleProblem, options: BundleOptions | None = None) -> Adjustment:
    """Fit all sensors, poses and lengths of a problem to everything that was observed.

    Parameters
    ----------
    problem
        With a start that is near enough for rays to meet near their spheres: within a fraction of a radius.
    options
        How; by default `BundleOptions()`.

    Returns
    -------
    With `warnings` where something disagrees.

    Raises
    ------
    CalibrationFailed
        When the observations leave a direction open (which is named), when sensors share no pose, when a
        pose's spheres are swapped, or when no minimum is found.

    Notes
    -----
    Minimises the sum over points of the Huber function of (epsilon_1, epsilon_2) (thesis Eq. (1.26), (1.27)),
    whitened, plus that of the boards' reprojection residuals, plus squares of what is known beforehand. The
    weights gamma_1, gamma_2 of the thesis are the inverse variances.
    """
    chosen = options or BundleOptions()
    packed = pack(problem)
    check_before(problem, packed)
    fit = _start(problem, packed, chosen)
    whole = fit.freedom
    fit.freedom = whole.without(inner_parameters(problem))
    _descend(problem, packed, chosen, fit, _COARSE)
    fit.freedom = whole
    _descend(problem, packed, chosen, fit, _ROUGH)
    for _ in range(_ROUNDS):
        live = _kept(fit.normal.observed, packed, fit.scale, chosen)
        changed = np.any(live.bar != fit.live.bar) or np.any(live.board != fit.live.board)
        if changed:
            _restrict(problem, packed, chosen, fit, live)
        _descend(problem, packed, chosen, fit, chosen.cost_tolerance)
        if not changed:
            break
    return _result(problem, packed, chosen, fit)


def _kept(observed: Observed, packed: Packed, scale: Floats, options: BundleOptions) -> Live:
    """Return the observations to keep: with a residual, near enough, on a ray that does not graze."""
    bar, board = distances(observed, packed, scale)
    with np.errstate(invalid="ignore"):
        facing = observed.bar_found[:, 2] > options.least_incidence
        return Live((bar <= options.reject) & facing, board <= options.reject)


def _enough(problem: BundleProblem, packed: Packed, live: Live) -> tuple[Live, Mask, Mask]:
    """Drop spheres and board poses with too few points; return what lives, and which are seen."""
    sphere = np.zeros((len(problem.bar_poses), 2), np.int64)
    board = np.zeros(len(problem.board_poses), np.int64)
    for block in packed.bars:
        sphere[block.pose, block.sphere] += live.bar[block.start : block.stop].sum()
    for block in packed.boards:
        board[block.pose] += live.board[block.start : block.stop].sum()
    seen_sphere, seen_board = sphere >= _FEWEST_ON_SPHERE, board >= _FEWEST_ON_BOARD
    kept = Live(live.bar.copy(), live.board.copy())
    for block in packed.bars:
        kept.bar[block.start : block.stop] &= seen_sphere[block.pose, block.sphere]
    for block in packed.boards:
        kept.board[block.start : block.stop] &= seen_board[block.pose]
    return kept, seen_board, seen_sphere


def _start(problem: BundleProblem, packed: Packed, options: BundleOptions) -> _Fit:
    """Return the fit at the problem's start, with every observation that has a residual there."""
    state = starting_state(problem)
    nothing_live = Live(
        np.zeros(len(packed.bar_observed), np.bool_), np.zeros(len(packed.board_observed), np.bool_)
    )
    scale = np.ones(4)
    first = evaluate(problem, packed, state, nothing_live, scale, options, Observed.empty(packed))
    live = _kept(first.observed, packed, scale, replace(options, reject=np.inf))
    live, seen_board, seen_sphere = _enough(problem, packed, live)
    if not (live.bar.any() or live.board.any()):
        raise CalibrationFailed(
            f"none of the {len(live.bar) + len(live.board)} points that were observed can be used: too few "
            "rays meet on a sphere or a board; start nearer, or check which sphere is which"
        )
    state.sphere[~seen_sphere, :3] = np.nan
    if options.estimate_variances:
        scale = first_scale(first.observed, packed, live)
    free = freedom(problem, seen_board, seen_sphere)
    normal = evaluate(problem, packed, state, live, scale, options, first.observed)
    check_counts(problem, packed, live, free)
    fit = _Fit(state, live, free, np.ones(4), normal)
    check_determined(problem, state, free, _summed(fit, options)[0])
    fit.scale = scale
    return fit


def _restrict(problem: BundleProblem, packed: Packed, options: BundleOptions, fit: _Fit, live: Live) -> None:
    """Go on with other observations."""
    fit.live, seen_board, seen_sphere = _enough(problem, packed, live)
    fit.state.sphere[~seen_sphere, :3] = np.nan
    fit.freedom = freedom(problem, seen_board, seen_sphere)
    fit.normal = evaluate(problem, packed, fit.state, fit.live, fit.scale, options, fit.normal.observed)


def _summed(fit: _Fit, options: BundleOptions) -> tuple[Floats, Floats]:
    """Return normal matrix, the inverse of the covariance, and gradient of the free parameters."""
    return fit.freedom.fold(*_whole(fit, options))


def _whole(fit: _Fit, options: BundleOptions) -> tuple[Floats, Floats]:
    """Return normal matrix and gradient of all parameters."""
    correction = Consistency.of(options.huber).correction
    normal = correction * type_scale(fit.normal.by_type, fit.scale) + fit.normal.prior
    # The gradient keeps its weights: it must vanish where the cost is least.
    gradient = type_scale(fit.normal.gradient, fit.scale) + fit.normal.prior_gradient
    return normal, gradient


def _cost(packed: Packed, options: BundleOptions, fit: _Fit, normal: Normal) -> float:
    return cost(normal.observed, packed, fit.live, fit.scale, options.huber) + normal.prior_cost


def _step(normal: Floats, gradient: Floats, damping: float) -> tuple[Floats, float]:
    """Return the damped Newton step and by how much it should lower the cost."""
    step = -solve(normal, gradient, damping)
    return step, float(-gradient @ step - 0.5 * np.sum(step * np.sum(normal * step, axis=1)))


def _absorbed(options: BundleOptions, fit: _Fit, normal: Floats) -> Floats:
    """Return how many residuals of each type the parameters take up, (4,): trace(N_k N^-1)."""
    found = inverse(normal)
    if found is None:
        return np.zeros(4)
    full = fit.freedom.unfold_covariance(found)
    correction = Consistency.of(options.huber).correction
    return np.array([correction * np.sum(own * full) for own in fit.normal.by_type]) / fit.scale**2


def _descend(
    problem: BundleProblem, packed: Packed, options: BundleOptions, fit: _Fit, tolerance: float
) -> None:
    """Bring the fit to the minimum with the observations that live."""
    damping, raised = _LEAST_DAMPING, 10.0
    absorbed = _absorbed(options, fit, _summed(fit, options)[0])
    while True:
        normal, gradient = _summed(fit, options)
        step, gain = _step(normal, gradient, damping)
        scale = fit.scale
        if options.estimate_variances:
            scale = estimate_scale(fit.normal.observed, packed, fit.live, scale, absorbed, options.huber)
        scale_converged = bool(np.all(np.abs(np.log(scale / fit.scale)) < _SCALE_TOLERANCE))
        fit.scale = scale
        here = _cost(packed, options, fit, fit.normal)
        if gain <= tolerance * (here + 1.0) and (scale_converged or tolerance >= _ROUGH):
            return
        if fit.iterations >= options.most_iterations and gain <= _GOOD_ENOUGH * (here + 1.0):
            return
        if fit.iterations >= options.most_iterations or damping > _MOST_DAMPING:
            check_determined(problem, fit.state, fit.freedom, normal)
            raise CalibrationFailed(
                f"the bundle adjustment found no minimum in {fit.iterations} iterations (a step still "
                f"promises {gain / (here + 1.0):.1e} of the cost, limit {tolerance:.0e}): start nearer, look "
                "for wrong points, or correct what is known worst: "
                + weakest_in_words(problem, fit.freedom, normal)
            )
        fit.iterations += 1
        moved = fit.state.moved(problem, fit.freedom.unfold(step))
        found = evaluate(problem, packed, moved, fit.live, fit.scale, options, fit.normal.observed)
        gained = here - found.old_cost - found.prior_cost
        if gained >= -1e-12 * here:
            fit.state, fit.normal = moved, found
            # Only where the cost is as quadratic as it was taken for may the next step be bolder.
            damping, raised = max((0.1 if gained > 0.5 * gain else 1.0) * damping, _LEAST_DAMPING), 10.0
        elif gain <= 1e-9 * (here + 1.0):
            return  # rounding decides whether so small a step gains anything
        else:
            damping, raised = raised * damping, 10.0 * raised


def _result(problem: BundleProblem, packed: Packed, options: BundleOptions, fit: _Fit) -> Adjustment:
    """Put together what was found; refuse it where a direction is open."""
    normal, _ = _summed(fit, options)
    by_points, points = _of_points(problem, packed, options, fit, normal)
    determined = check_determined(problem, fit.state, fit.freedom, normal, by_points)
    covariance, warnings = determined.covariance, determined.warnings
    absorbed = _absorbed(options, fit, normal)
    count = 2.0 * float(fit.live.bar.sum() + fit.live.board.sum())
    lengths = nuisances(problem, fit.state, fit.freedom, covariance)
    in_mm = object_residuals(packed, fit.state)
    rms = rms_tables(problem, packed, fit.normal.observed, in_mm, fit.live)
    warnings += points.warnings + prior_warnings(lengths)
    warnings += changed_lenses(problem, fit.state, fit.freedom, covariance, by_points)
    warnings += pose_warnings(problem, packed, fit.live, rms)
    used, residuals = per_item(problem, packed, fit.normal.observed, in_mm, fit.live)
    return Adjustment(
        sensors=adjusted_sensors(problem, fit.state),
        board_poses=board_poses(problem, fit.state),
        centres=fit.state.sphere[:, :, :3].copy(),
        nuisance=lengths,
        names=parameter_names(problem),
        covariance=covariance,
        free=fit.freedom.free,
        gauge=problem.gauge,
        iterations=fit.iterations,
        cost=_cost(packed, options, fit, fit.normal),
        redundancy=count - float(absorbed.sum()),
        variance_factors={
            kind: float(fit.scale[k]) for k, kind in enumerate(ResidualType) if _occurs(packed, kind)
        },
        rms=rms,
        refused=refusals(packed, fit.normal.observed, fit.live, fit.scale, options),
        used_board=used[1],
        used_bar=used[0],
        residual_board=residuals[1],
        residual_bar=residuals[0],
        warnings=warnings,
        point_rms_mm=points.rms_mm,
        shape_sigma_mm=determined.shape_mm,
        scale_sigma=determined.scale,
        missing_radial=missing_radial(
            problem,
            packed,
            fit.live,
            fit.freedom,
            _whole(fit, options),
            fit.normal.observed,
            fit.scale,
        ),
    )


def _of_points(
    problem: BundleProblem, packed: Packed, options: BundleOptions, fit: _Fit, normal: Floats
) -> tuple[Floats | None, PointsFound]:
    """Return what the places of boards' points add to the covariance, and whether they are as told."""
    nothing = PointsFound(0.0, ())
    equations = point_equations(problem, packed, fit.state, fit.normal.observed, fit.scale)
    found = inverse(normal)
    if equations is None or found is None or not len(found):
        return None, nothing
    added = placement_covariance(problem, equations, fit.freedom, found)
    return added, judge_points(problem, equations, fit.freedom, found) if options.judge_points else nothing


def _occurs(packed: Packed, kind: ResidualType) -> bool:
    if not kind.of_board:
        return bool(packed.bars)
    return any(ResidualType.of_board_in(block.projector) is kind for block in packed.boards)
