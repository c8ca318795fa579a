"""Values along a line, taken together as far as they agree: kriging of a roughness that they tell.

What is sought is a straight line and a walk that strays from it. How much it strays is not known; every
roughness counts by its likelihood, so that the variance holds what is not known of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.cracks.polylines import evened, way_along

_FINEST = 0.25  # of the distance of values, the shortest length over which they are taken together
_FINER = 2.0**0.5  # ratio of such lengths
_LEAST_FREEDOM = 0.5  # degrees that tell by how much values scatter
_LEAST_PLACES = 4  # that tell where a line goes


@dataclass(frozen=True)
class Walk:
    """What a walk of unit roughness and a straight line make of n values and of m sought ones.

    Attributes
    ----------
    among, towards, own
        (n, n), (m, n), (m,): covariances of the values, of the sought with them, and variances of the sought.
    lines, sought
        (n, 2), (m, 2): the same of a constant and a slope.
    order
        Of the differences by which values at one distance stray: 1 for a walk, 2 for one of slopes.
    """

    among: Floats
    towards: Floats
    own: Floats
    lines: Floats
    sought: Floats
    order: int


def walk(at: Floats, where: Floats, width: float) -> Walk:
    """Return a random walk that is observed at (n,) and sought at (m,) along a line.

    Each value is a mean over a `width`, which strays from its middle by a twelfth of what a walk does over
    such a way.
    """
    start = min(at[0], where[0])
    at, where = at - start, where - start
    return Walk(
        np.minimum.outer(at, at) + width / 12.0 * np.eye(len(at)),
        np.minimum.outer(where, at),
        where,
        _line(at),
        _line(where),
        1,
    )


def walk_of_slopes(at: Floats, where: Floats) -> Walk:
    """Return one whose slope is a random walk: of what is sought, (m,), first all values, then all slopes."""
    start = min(at[0], where[0])
    at, where = at - start, where - start
    near, far = np.minimum.outer(where, at), np.maximum.outer(where, at)
    least, most = np.minimum.outer(at, at), np.maximum.outer(at, at)
    return Walk(
        least**2 * (3.0 * most - least) / 6.0,
        np.concatenate([near**2 * (3.0 * far - near) / 6.0, at * near - 0.5 * near**2]),
        np.concatenate([where**3 / 3.0, where]),
        _line(at),
        np.concatenate([_line(where), np.repeat([[0.0, 1.0]], len(where), axis=0)]),
        2,
    )


def _line(at: Floats) -> Floats:
    return np.stack([np.ones_like(at), at], axis=1)


def estimated(of: Walk, values: Floats, noise: Floats | None = None) -> tuple[Floats, Floats]:
    """Return what is sought of a walk, (m, k), and its variances (m,).

    Parameters
    ----------
    of
        The walk.
    values
        (n, k): one column, or the components of places that stray from their line across it alone.
    noise
        (n, n), the covariance of one column; None for independent noise of which nothing is known.

    Notes
    -----
    Universal kriging (Cressie 1993, section 3.4) with the restricted likelihood of the roughness (Patterson
    and Thompson 1971). The roughness is told by the length over which values are taken together. Lengths are
    in steps of the square root of two, all alike before anything is known, from a quarter of the distance of
    values, or less where they differ more than that would let them, to all of the line.
    """
    known = noise is not None
    scatter = np.eye(len(values)) if noise is None else noise
    found = [_kriged(of, values, scatter, q, known) for q in _roughnesses(of, values, scatter, known)]
    likelihood = np.array([one.likelihood for one in found])
    weight = np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    sought = np.einsum("q,qmk->mk", weight, np.array([one.sought for one in found]))
    spread = [one.variance + np.sum((one.sought - sought) ** 2, axis=1) for one in found]
    return sought, weight @ np.array(spread)


def _roughnesses(of: Walk, values: Floats, noise: Floats, known: bool) -> Floats:
    """Return roughnesses that values may have, in falling order; 0 at last."""
    at = of.lines[:, 1]
    step, variance = float(np.median(np.diff(at))), float(np.trace(noise)) / len(at)
    differences = np.diff(values, n=of.order, axis=0)
    most = float(np.mean(np.sum(differences**2, axis=1))) if known and len(differences) else 0.0
    power = 2 * of.order
    finest = _FINEST * step * min(1.0, (variance / max(most, 1e-300)) ** (1.0 / power))
    count = int(np.ceil(np.log(max((at[-1] - at[0]) / finest, 1.0)) / np.log(_FINER))) + 1
    return np.append(variance * step / (finest * _FINER ** np.arange(count)) ** power, 0.0)


@dataclass(frozen=True)
class _Kriged:
    """What is sought and its variance for one roughness, and the logarithm of the likelihood of that."""

    sought: Floats
    variance: Floats
    likelihood: float


def _kriged(of: Walk, values: Floats, noise: Floats, roughness: float, known: bool) -> _Kriged:
    factor = linalg.cho_factor(noise + roughness * of.among, lower=True)
    lines = linalg.cho_solve(factor, of.lines)
    normal = of.lines.T @ lines
    trend = np.linalg.solve(normal, lines.T @ values)
    left = linalg.cho_solve(factor, values - of.lines @ trend)
    towards = roughness * of.towards
    beyond = of.sought - towards @ lines
    variance = roughness * of.own
    variance = variance - np.sum(towards * linalg.cho_solve(factor, towards.T).T, axis=1)
    variance += np.sum(beyond * np.linalg.solve(normal, beyond.T).T, axis=1)
    squares = float(np.sum(left * values))
    freedom = len(values) - 2
    volume = 2.0 * float(np.log(np.diag(factor[0])).sum()) + float(np.linalg.slogdet(normal)[1])
    if known:
        scale, likelihood = 1.0, -0.5 * (volume + squares)
    else:
        scale = squares / max(freedom - 2.0, _LEAST_FREEDOM)
        likelihood = -0.5 * (volume + freedom * np.log(max(squares, 1e-300)))
    return _Kriged(of.sought @ trend + towards @ left, scale * np.maximum(variance, 0.0), likelihood)


@dataclass(frozen=True)
class Course:
    """Where a line goes.

    Attributes
    ----------
    way
        (m,), how far along it places are.
    place, ahead
        (m, 2): places, and unit vectors along it.
    error
        (m,), standard deviation of its direction in rad.
    """

    way: Floats
    place: Floats
    ahead: Floats
    error: Floats


def course(place: Floats, part: Floats, radius: int) -> Course:
    """Return where a line through scattered points (n, 2) in their order goes, at parts (m,) of its way.

    What lies within one subset of `radius` goes astray together: its mean is one place of the line, whose
    slope is a walk.
    """
    way = way_along(place)
    even, along = evened(place, way, 1.0), way_along(evened(place, way, radius))
    groups = np.array_split(np.arange(len(even)), max(len(even) // (2 * radius + 1), _LEAST_PLACES))
    at = np.array([along[group].mean() for group in groups])
    middle = np.array([even[group].mean(axis=0) for group in groups])
    where = np.asarray(part) * along[-1]
    found, variance = estimated(walk_of_slopes(at, where), middle)
    ahead = found[len(where) :]
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    return Course(where, found[: len(where)], ahead, np.sqrt(variance[len(where) :]))
