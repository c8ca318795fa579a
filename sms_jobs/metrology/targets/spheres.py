"""The spheres of a ball bar in an organised point cloud: looked for, measured, numbered."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import degrees, pi, radians

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.targets.sphere_fit import SphereFit, fit_sphere, spread_pixels
from sms_jobs.metrology.targets.sphere_layout import SEPARATION_TOLERANCE, Sphere, SphereLayout
from sms_jobs.metrology.targets.sphere_votes import Peak, sphere_peaks

INCIDENCE_LIMIT = radians(60.0)
"""Points seen more obliquely are left out: light scatters across a limb, and depth there means little."""

TWO_SPHERES = SphereLayout()
"""Two spheres of which nothing is known beforehand but their radius."""

_PEAKS = 12  # tried: two spheres, and ten other things that look like one
_FAINT = 0.25  # of the votes of the spheres found already: not tried once there are enough of these
_LEAST_PIXELS = 50
_LEAST_COVERAGE = 0.3
_LEAST_ON_SURFACE = 0.5  # of the pixels within the outline: spheres are opaque, and mostly in full view
_TOGETHER = 2  # points off the surface, in a square of three pixels; more are a thing
_ROUGHEST = 0.03  # of the radius, beyond what the noise explains
_RADIUS_TOLERANCE = 0.05


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


@dataclass(frozen=True)
class _Cloud:
    """Points (3, rows, columns) in mm, their standard deviation along the rays, the pixels to look at.

    `sigma` and `region` are (rows, columns), `camera` (3,) is the pin-hole that the rays start from.
    """

    points: Floats
    sigma: NDArray[np.floating]
    region: Mask
    camera: Floats


def find_spheres(
    points: Floats,
    point_sigma: NDArray[np.floating] | float,
    radius_mm: float,
    camera_centre: Floats,
    *,
    layout: SphereLayout = TWO_SPHERES,
    region: Mask | None = None,
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
    layout
        How many spheres there are, and what is known beforehand of where they are.
    region
        (rows, columns): which pixels to look at; None for all.
    select
        Most points to select of each sphere.
    incidence_limit
        Points seen more obliquely are left out, in rad.
    threads
        Results do not depend on it.

    Notes
    -----
    Raises `InvalidInput` for arrays that do not belong together; what the cloud itself lacks is reported in
    `problems`.
    """
    if select < 1 or not 0.0 < incidence_limit < 0.5 * pi:
        raise InvalidInput(
            "at least 1 point is selected, seen at an incidence between 0 and 90 degrees; "
            f"not {select} points below {degrees(incidence_limit):g} degrees"
        )
    cloud = _checked(points, point_sigma, radius_mm, region, camera_centre)
    candidates, refused = _candidates(cloud, radius_mm, layout.count, incidence_limit, select, threads)
    members = layout.members(candidates)
    if len(candidates) > len(members):
        refused["another sphere"] = len(candidates) - len(members)
    spheres, doubts = layout.numbered(members)
    separation = (
        float(np.linalg.norm(spheres[1].centre - spheres[0].centre)) if len(spheres) > 1 else float("nan")
    )
    search = SphereSearch(
        spheres=spheres,
        searched_fraction=np.count_nonzero(cloud.region) / cloud.region.size,
        refused=refused,
        separation_mm=separation,
        problems=tuple(doubts),
    )
    return replace(search, problems=_problems(search, layout, radius_mm, len(candidates)))


def _candidates(
    cloud: _Cloud, radius_mm: float, count: int, incidence_limit: float, select: int, threads: int
) -> tuple[list[Sphere], dict[str, int]]:
    """Return all spheres of the radius that the cloud shows, and how many peaks are none, by reason."""
    candidates: list[Sphere] = []
    refused: dict[str, int] = {}
    for peak in sphere_peaks(cloud.points, cloud.region, cloud.camera, radius_mm, _PEAKS, threads):
        if len(candidates) >= count and peak.votes < _FAINT * sorted(s.votes for s in candidates)[-count]:
            break
        sphere = _measure(cloud, peak, radius_mm, incidence_limit, select)
        if isinstance(sphere, Sphere) and any(
            np.linalg.norm(sphere.centre - other.centre) < radius_mm for other in candidates
        ):
            sphere = "found twice"
        if isinstance(sphere, str):
            refused[sphere] = refused.get(sphere, 0) + 1
        else:
            candidates.append(sphere)
    return candidates, refused


def _problems(
    search: SphereSearch, layout: SphereLayout, radius_mm: float, candidates: int
) -> tuple[str, ...]:
    """Return what makes a search doubtful: its doubts about numbers, and the rest.

    `candidates` is how many spheres of the radius the cloud shows.
    """
    problems = list(search.problems)
    if len(search.spheres) < layout.count:
        problems.insert(
            0,
            f"{len(search.spheres)} of {layout.count} spheres of {radius_mm:g} mm radius were found"
            f"{_reasons(search.refused)}; check lighting and region",
        )
    elif layout.bar_length_mm is not None and not layout.fits(search.separation_mm):
        problems.append(
            f"the spheres are {search.separation_mm:.3f} mm apart, not {layout.bar_length_mm:.3f} mm within "
            f"{SEPARATION_TOLERANCE:.0%}; check the bar's length, or the calibration the cloud is made with"
        )
    if layout.predicted is None and layout.bar_length_mm is None and candidates > layout.count:
        problems.append(
            f"{candidates} spheres of {radius_mm:g} mm radius were found in place of {layout.count}, and "
            "those with most pixels taken; give the bar's length or a region"
        )
    problems += [
        f"sphere {s.number} is {s.off_prediction_mm:.1f} mm from its predicted centre, more than its radius; "
        "check the stage's angles"
        for s in search.spheres
        if s.off_prediction_mm > radius_mm
    ]
    return tuple(problems)


def _checked(
    points: Floats,
    point_sigma: NDArray[np.floating] | float,
    radius_mm: float,
    region: Mask | None,
    camera_centre: Floats,
) -> _Cloud:
    """Return the cloud; raise `InvalidInput` for arrays that do not belong together."""
    if np.ndim(points) != 3 or len(points) != 3:
        raise InvalidInput(f"a point cloud has the shape (3, rows, columns), not {np.shape(points)}")
    shape = points.shape[1:]
    if not radius_mm > 0.0:
        raise InvalidInput(f"the radius of a sphere is above 0 mm, not {radius_mm:g} mm")
    sigma = np.broadcast_to(np.asarray(point_sigma), shape) if np.ndim(point_sigma) == 0 else point_sigma
    looked_at = np.ones(shape, dtype=np.bool_) if region is None else np.ascontiguousarray(region, np.bool_)
    assert not isinstance(sigma, float)
    for name, array in (("standard deviations", sigma), ("region", looked_at)):
        if array.shape != shape:
            raise InvalidInput(f"the {name} of a cloud of {shape} pixels cannot have the shape {array.shape}")
    return _Cloud(
        np.ascontiguousarray(points, dtype=np.float64),
        sigma,
        looked_at,
        np.asarray(camera_centre, dtype=np.float64),
    )


def _measure(
    cloud: _Cloud, peak: Peak, radius_mm: float, incidence_limit: float, select: int
) -> Sphere | str:
    """Return the sphere at a peak, or why there is none."""
    # The voters leave out the limb and, in a sparse grid, up to a step at each side.
    margins = [(stop - start) // 4 + 4 for start, stop in (peak.rows, peak.columns)]
    rows = slice(max(0, peak.rows[0] - margins[0]), peak.rows[1] + margins[0])
    columns = slice(max(0, peak.columns[0] - margins[1]), peak.columns[1] + margins[1])
    window = cloud.points[:, rows, columns]
    deviation = np.asarray(cloud.sigma[rows, columns], dtype=np.float64)
    measured = np.isfinite(window).all(axis=0) & cloud.region[rows, columns]
    usable = measured & (deviation > 0.0) & np.isfinite(deviation)
    fit = fit_sphere(
        window[:, usable].T, deviation[usable], cloud.camera, peak.centre, radius_mm, incidence_limit
    )
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
            window[:, usable].T, deviation[usable], cloud.camera, fit.centre, radius_mm, incidence_limit
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


def _beside(usable: Mask, fit: SphereFit) -> Mask:
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


def _reasons(refused: dict[str, int]) -> str:
    if not refused:
        return ""
    return " (candidates refused: " + ", ".join(f"{n} {why}" for why, n in refused.items()) + ")"
