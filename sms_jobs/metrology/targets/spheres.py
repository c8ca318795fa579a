"""The spheres of a ball bar in an organised point cloud: found, measured, told apart."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import degrees, pi, radians

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.targets.sphere_fit import SphereFit, fit_sphere, spread_pixels
from sms_jobs.metrology.targets.sphere_votes import Peak, sphere_peaks

Floats = NDArray[np.float64]

INCIDENCE_LIMIT = radians(60.0)
"""Points seen more obliquely are left out: light scatters across a limb, and depth there means little."""

_PEAKS = 12  # tried: two spheres, and ten other things that look like one
_FAINT = 0.25  # of the votes of the spheres found already: not tried once there are enough of these
_LEAST_PIXELS = 50
_LEAST_COVERAGE = 0.3
_LEAST_ON_SURFACE = 0.5  # of the pixels within the outline: spheres are opaque, and mostly in full view
_TOGETHER = 2  # points off the surface, in a square of three pixels; more are a thing
_ROUGHEST = 0.03  # of the radius, beyond what the noise explains
_RADIUS_TOLERANCE = 0.05
_SEPARATION_TOLERANCE = 0.01  # of the bar; an earlier calibration is better than that
_AMBIGUOUS = 0.25  # of the separation: labels are doubtful when the other order is hardly worse


@dataclass(frozen=True)
class Sphere:
    """One sphere that was found.

    Attributes
    ----------
    number
        1, 2, ...: which of the artefact's spheres it is.
    centre, covariance
        (3,) in mm and (3, 3) in mm^2, from the noise of its points.
    radius, radius_sigma
        In mm, when the radius is free too: a check of scale and of noise.
    rms, misfit
        Of the residuals along the rays, in mm and in standard deviations.
    coverage
        Part of the cap within the limit of incidence that has points.
    votes
        Points that voted for it.
    pixels
        (n, 2) int32: row and column of the pixels that the centre was fitted to.
    selected
        (m,) which of `pixels` to hand on: evenly spread, at most as many as asked for.
    refused
        Pixels of its surroundings that were left out, by reason.
    off_prediction_mm
        Distance from its predicted centre; NaN without a prediction.
    """

    number: int
    centre: Floats
    covariance: Floats
    radius: float
    radius_sigma: float
    rms: float
    misfit: float
    coverage: float
    votes: int
    pixels: NDArray[np.int32]
    selected: NDArray[np.int64]
    refused: dict[str, int]
    off_prediction_mm: float


@dataclass(frozen=True)
class SphereSearch:
    """What a search for spheres brought.

    Attributes
    ----------
    spheres
        In order of number; fewer than were asked for where the cloud shows fewer.
    searched_fraction
        Part of the image's pixels that was looked at.
    refused
        Candidates that were no spheres, or not those of the bar, by reason.
    separation_mm
        Distance of the first two centres; NaN with fewer than two.
    problems
        Sentences, each of which makes the result doubtful; empty for a sound one.
    """

    spheres: tuple[Sphere, ...]
    searched_fraction: float
    refused: dict[str, int]
    separation_mm: float
    problems: tuple[str, ...]


def find_spheres(
    points: Floats,
    point_sigma: NDArray[np.floating] | float,
    radius_mm: float,
    camera_centre: Floats,
    *,
    region: NDArray[np.bool_] | None = None,
    count: int = 2,
    predicted: Floats | None = None,
    bar_length_mm: float | None = None,
    order_along: tuple[float, float, float] = (1.0, 0.0, 0.0),
    select: int = 500,
    incidence_limit: float = INCIDENCE_LIMIT,
    threads: int = 1,
) -> SphereSearch:
    """Find the spheres of known radius in a point cloud, measure their centres and tell them apart.

    Parameters
    ----------
    points
        (3, rows, columns) in mm; NaN where nothing was measured.
    point_sigma
        (rows, columns) or one number: standard deviation of the points along the camera's rays, in mm (the
        root of the covariance's trace); NaN leaves a point out.
    radius_mm
        Of every sphere.
    camera_centre
        (3,) pin-hole of the camera whose pixels these are, in mm.
    region
        (rows, columns): which pixels to look at; None for all.
    count
        How many spheres there are.
    predicted
        (count, 3) where their centres should be, in mm; spheres are numbered by the least total distance.
    bar_length_mm
        Distance of the centres of a bar's two spheres; tells them from other spheres and is checked.
    order_along
        Without a prediction spheres are numbered in this direction: by default sphere 2 is that of greater
        X (thesis section 3.3.4).
    select
        Most points to select of each sphere.
    incidence_limit
        Points seen more obliquely are left out, in rad.
    threads
        Results do not depend on it.

    Notes
    -----
    Raises `InvalidInput` for arrays that do not belong together; what the cloud itself lacks is told in
    `problems`.
    """
    if select < 1 or not 0.0 < incidence_limit < 0.5 * pi:
        raise InvalidInput(
            "at least 1 point is selected, seen at an incidence between 0 and 90 degrees; "
            f"not {select} points below {degrees(incidence_limit):g} degrees"
        )
    sigma, looked_at = _checked(points, point_sigma, radius_mm, region, count, predicted, bar_length_mm)
    points = np.ascontiguousarray(points, dtype=np.float64)
    camera = np.asarray(camera_centre, dtype=np.float64)
    found: list[Sphere] = []
    refused: dict[str, int] = {}
    for peak in sphere_peaks(points, looked_at, camera, radius_mm, _PEAKS, threads):
        if len(found) >= count and peak.votes < _FAINT * sorted(s.votes for s in found)[-count]:
            break
        sphere = _measure(points, sigma, looked_at, camera, peak, radius_mm, incidence_limit, select)
        if isinstance(sphere, Sphere) and any(
            np.linalg.norm(sphere.centre - other.centre) < radius_mm for other in found
        ):
            sphere = "found twice"
        if isinstance(sphere, str):
            refused[sphere] = refused.get(sphere, 0) + 1
        else:
            found.append(sphere)
    chosen = _choose(found, count, predicted, bar_length_mm)
    if len(found) > len(chosen):
        refused["another sphere"] = len(found) - len(chosen)
    spheres, problems = _number(chosen, predicted, np.asarray(order_along, dtype=np.float64))
    separation = (
        float(np.linalg.norm(spheres[1].centre - spheres[0].centre)) if len(spheres) > 1 else float("nan")
    )
    if len(spheres) < count:
        problems.insert(
            0,
            f"{len(spheres)} of {count} spheres of {radius_mm:g} mm radius were found"
            f"{_reasons(refused)}; check lighting and region",
        )
    elif bar_length_mm is not None and not _fits(separation, bar_length_mm):
        problems.append(
            f"the spheres are {separation:.3f} mm apart, not {bar_length_mm:.3f} mm within "
            f"{_SEPARATION_TOLERANCE:.0%}; check the bar's length, or the calibration the cloud is made with"
        )
    if predicted is None and bar_length_mm is None and len(found) > count:
        problems.append(
            f"{len(found)} spheres of {radius_mm:g} mm radius were found in place of {count}, and those with "
            "most pixels taken; give the bar's length or a region"
        )
    problems += [
        f"sphere {s.number} is {s.off_prediction_mm:.1f} mm from its predicted centre, more than its radius; "
        "check the stage's angles"
        for s in spheres
        if s.off_prediction_mm > radius_mm
    ]
    return SphereSearch(
        spheres=spheres,
        searched_fraction=np.count_nonzero(looked_at) / looked_at.size,
        refused=refused,
        separation_mm=separation,
        problems=tuple(problems),
    )


def _checked(
    points: Floats,
    point_sigma: NDArray[np.floating] | float,
    radius_mm: float,
    region: NDArray[np.bool_] | None,
    count: int,
    predicted: Floats | None,
    bar_length_mm: float | None,
) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    if np.ndim(points) != 3 or len(points) != 3:
        raise InvalidInput(f"a point cloud has the shape (3, rows, columns), not {np.shape(points)}")
    shape = points.shape[1:]
    if not radius_mm > 0.0:
        raise InvalidInput(f"the radius of a sphere is above 0 mm, not {radius_mm:g} mm")
    if count < 1 or (bar_length_mm is not None and count != 2):
        raise InvalidInput(f"at least 1 sphere can be sought, and on a bar 2, not {count}")
    if predicted is not None and np.shape(predicted) != (count, 3):
        raise InvalidInput(
            f"{count} predicted centres have the shape ({count}, 3), not {np.shape(predicted)}"
        )
    sigma = np.broadcast_to(np.asarray(point_sigma), shape) if np.ndim(point_sigma) == 0 else point_sigma
    looked_at = np.ones(shape, dtype=np.bool_) if region is None else np.ascontiguousarray(region, np.bool_)
    assert not isinstance(sigma, float)
    for name, array in (("standard deviations", sigma), ("region", looked_at)):
        if array.shape != shape:
            raise InvalidInput(f"the {name} of a cloud of {shape} pixels cannot have the shape {array.shape}")
    return sigma, looked_at


def _measure(
    points: Floats,
    sigma: NDArray[np.floating],
    region: NDArray[np.bool_],
    camera: Floats,
    peak: Peak,
    radius_mm: float,
    incidence_limit: float,
    select: int,
) -> Sphere | str:
    """Return the sphere at a peak, or why there is none."""
    # The voters leave out the limb and, in a sparse grid, up to a step at each side.
    margins = [(stop - start) // 4 + 4 for start, stop in (peak.rows, peak.columns)]
    rows = slice(max(0, peak.rows[0] - margins[0]), peak.rows[1] + margins[0])
    columns = slice(max(0, peak.columns[0] - margins[1]), peak.columns[1] + margins[1])
    window = points[:, rows, columns]
    deviation = np.asarray(sigma[rows, columns], dtype=np.float64)
    measured = np.isfinite(window).all(axis=0) & region[rows, columns]
    usable = measured & (deviation > 0.0) & np.isfinite(deviation)
    fit = fit_sphere(window[:, usable].T, deviation[usable], camera, peak.centre, radius_mm, incidence_limit)
    if fit is None:
        return "no sphere could be fitted"
    reason = _why_not(fit, float(np.median(deviation[usable])), radius_mm)
    if reason:
        return reason
    refused = {
        "seen too obliquely": int(np.count_nonzero(fit.limb)),
        "in front of the surface": int(np.count_nonzero(fit.front)),
        "behind the surface": int(np.count_nonzero(fit.behind)),
        "beside something else": 0,
        "no standard deviation": int(np.count_nonzero(measured & ~usable)),
    }
    beside = _beside(usable, fit)
    if beside.any():
        refused["beside something else"] = int(np.count_nonzero(beside[usable] & fit.inlier))
        usable &= ~beside
        fit = fit_sphere(
            window[:, usable].T, deviation[usable], camera, fit.centre, radius_mm, incidence_limit
        )
        if fit is None or np.count_nonzero(fit.inlier) < _LEAST_PIXELS:
            return f"fewer than {_LEAST_PIXELS} pixels"
    pixels = np.argwhere(usable)[fit.inlier] + [rows.start, columns.start]
    return Sphere(
        number=0,
        centre=fit.centre,
        covariance=fit.covariance,
        radius=fit.radius,
        radius_sigma=fit.radius_sigma,
        rms=fit.rms,
        misfit=fit.misfit,
        coverage=fit.coverage,
        votes=peak.votes,
        pixels=pixels.astype(np.int32),
        selected=spread_pixels(pixels.astype(np.int32), select),
        refused=refused,
        off_prediction_mm=float("nan"),
    )


def _beside(usable: NDArray[np.bool_], fit: SphereFit) -> NDArray[np.bool_]:
    """Return the pixels within two of something that covers the sphere or joins it, such as the bar.

    Where it meets the sphere its points are within the noise of the surface, all to the same side. Points
    that are off alone, or two together, are no thing.
    """
    off = np.zeros(usable.shape, dtype=np.bool_)
    off[usable] = fit.front | fit.behind
    around = ndimage.convolve(off.astype(np.int32), np.ones((3, 3), dtype=np.int32), mode="constant")
    thing = off & (around > _TOGETHER)
    return np.asarray(ndimage.binary_dilation(thing, np.ones((3, 3)), iterations=2))


def _why_not(fit: SphereFit, sigma: float, radius_mm: float) -> str | None:
    """Return why a fit is not one of the spheres that are sought, or None."""
    on_surface = np.count_nonzero(fit.inlier)
    within = on_surface + np.count_nonzero(fit.front) + np.count_nonzero(fit.behind)
    if on_surface < _LEAST_PIXELS:
        return f"fewer than {_LEAST_PIXELS} pixels"
    if on_surface < _LEAST_ON_SURFACE * within:
        return "most of what is seen there is not on the sphere"
    if fit.coverage < _LEAST_COVERAGE:
        return "too little of the cap is seen"
    if fit.rms > _ROUGHEST * radius_mm + 3.0 * sigma:
        return "not round"
    if abs(fit.radius - radius_mm) > max(_RADIUS_TOLERANCE * radius_mm, 5.0 * fit.radius_sigma):
        return "another radius"
    return None


def _fits(separation: float, bar_length_mm: float) -> bool:
    return abs(separation - bar_length_mm) <= _SEPARATION_TOLERANCE * bar_length_mm


def _choose(
    found: list[Sphere], count: int, predicted: Floats | None, bar_length_mm: float | None
) -> list[Sphere]:
    """Return those that are meant: nearest to the prediction, as far apart as the bar, most points."""
    if len(found) <= count:
        return found
    if predicted is not None:
        _, members = linear_sum_assignment(_distances(predicted, found))
        return [found[i] for i in members]
    ranked = sorted(found, key=lambda sphere: -len(sphere.pixels))
    if bar_length_mm is not None:
        for pair in combinations(ranked, 2):
            if _fits(float(np.linalg.norm(pair[0].centre - pair[1].centre)), bar_length_mm):
                return list(pair)
    return ranked[:count]


def _distances(predicted: Floats, spheres: list[Sphere]) -> Floats:
    """Return the distance of each sphere (columns) from each predicted centre (rows), in mm."""
    centres = np.array([sphere.centre for sphere in spheres])
    return np.asarray(np.linalg.norm(predicted[:, None] - centres, axis=-1))


def _number(
    spheres: list[Sphere], predicted: Floats | None, order_along: Floats
) -> tuple[tuple[Sphere, ...], list[str]]:
    """Return the spheres with their numbers, and what is doubtful about these."""
    if not spheres:
        return (), []
    problems: list[str] = []
    if predicted is None:
        ordered = sorted(spheres, key=lambda sphere: float(sphere.centre @ order_along))
        return tuple(replace(sphere, number=i + 1) for i, sphere in enumerate(ordered)), []
    distance = _distances(predicted, spheres)
    rows, columns = linear_sum_assignment(distance)
    if predicted.shape == (2, 3):
        # How much worse the other numbering would be, against the most that it can be.
        best = float(distance[rows, columns].sum())
        other = float(distance[1 - rows, columns].sum())
        separation = float(np.linalg.norm(predicted[1] - predicted[0]))
        if other - best < _AMBIGUOUS * separation * len(spheres):
            problems.append(
                f"the spheres' numbers are doubtful: they are {best:.1f} mm from the predicted centres, and "
                f"{other:.1f} mm the other way round; check the stage's angles"
            )
    numbered = [
        replace(spheres[c], number=int(r) + 1, off_prediction_mm=float(distance[r, c]))
        for r, c in zip(rows, columns, strict=True)
    ]
    return tuple(numbered), problems


def _reasons(refused: dict[str, int]) -> str:
    if not refused:
        return ""
    return " (candidates refused: " + ", ".join(f"{n} {why}" for why, n in refused.items()) + ")"
