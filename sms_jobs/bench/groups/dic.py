"""Matching of image subsets: speed, bias, scatter, and what regions are worth at an edge."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sms_jobs.bench.correlated.half_and_half import HALVES, match_halves
from sms_jobs.bench.correlated.speckle_pairs import quadratic, shift, speckle_pair
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run, cpu_seconds
from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    Matches,
    MatchSettings,
    Noise,
    PreparedImages,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import REFINEMENT, GridSettings, match_grid
from sms_jobs.metrology.deformation.matching.sampling import choose_seeds, sample_nodes
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings, seed_displacements
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.images.spline import Interpolant

RADIUS = 16
_NOISE = 10.0  # grey levels, a fortieth of the speckle's contrast
_STRETCH = 0.002
_CURVATURE = 2e-4  # 1 / px
_EDGE_ERROR = 0.05  # px from which a point counts as spoilt by an edge
_RATE_TARGETS: tuple[tuple[ShapeOrder, float], ...] = ((1, 20_000.0), (2, 10_000.0))


@dataclass(frozen=True)
class Points:
    """Places of an image and the true displacement there."""

    x: Ints
    y: Ints
    truth: Floats


def places(size: int, rim: int, step: int) -> tuple[Ints, Ints]:
    """Return a grid of points, at least `rim` px from an image's border."""
    y, x = (a.ravel() for a in np.mgrid[rim : size - rim : step, rim : size - rim : step])
    return x, y


def labelled(reference: Floats, deformed: Floats, noise: float = 0.0) -> PreparedImages:
    """Return a pair of one region, ready to be matched."""
    model = Noise(noise * noise, 0.0)
    return prepare_images(reference, deformed, np.ones(reference.shape, np.int32), (model, model))


def matched(images: PreparedImages, points: Points, order: ShapeOrder) -> Matches:
    """Match points from the true displacement, rounded to whole pixels."""
    guess = np.zeros((len(points.x), 6))
    guess[:, [0, 3]] = np.rint(points.truth)
    return match_points(images, points.x, points.y, guess, MatchSettings(RADIUS, shape_order=order))


def errors(images: PreparedImages, points: Points, order: ShapeOrder) -> tuple[Floats, Floats]:
    """Return the errors of u and v (n, 2) and their stated standard deviations, of points that converge."""
    found = matched(images, points, order)
    good = found.ending == CONVERGED
    return (found.warp[:, [0, 3]] - points.truth)[good], found.sigma[good]


def stretched(size: int) -> tuple[Floats, Floats]:
    """Return a noisy pair, stretched by 0.2 % along x."""
    pair = speckle_pair(size, lambda x, y: (_STRETCH * x + 0.2, np.full_like(y, 0.3)), 1)
    rng = np.random.default_rng(2)
    first, second = (image + rng.normal(0.0, _NOISE, image.shape) for image in pair)
    return first, second


def warm_up() -> None:
    """Compile what the rates use."""
    pair = speckle_pair(64, shift(0.0, 0.0), 1)
    points = Points(*places(64, 30, 2), np.zeros((4, 2)))
    for order, _ in _RATE_TARGETS:
        matched(labelled(*pair), points, order)


def _speed(run: Run) -> Iterator[Found]:
    size = 256 if run.quick else 512
    run.say("dic: points per CPU-second")
    pair = stretched(size)
    images = labelled(*pair, noise=_NOISE)
    x, y = places(size, 30, 5)
    points = Points(x, y, np.stack([_STRETCH * x + 0.2, np.full(len(y), 0.3)], axis=1))
    iterations = []
    for order, target in _RATE_TARGETS:
        iterations.append(float(matched(images, points, order).iterations.mean()))
        rate = len(x) / cpu_seconds(lambda o=order: matched(images, points, o))  # type: ignore[misc]
        yield Figure(f"icgn{order}_r16_points_per_cpu_s", rate, "points / CPU-s", target)
    yield Condition(
        "icgn",
        f"{len(x)} points of a {size} px image, radius {RADIUS} px, stretched by {_STRETCH:.1%}, noise of "
        f"{_NOISE / 400.0:.1%} of the contrast, quintic spline, from whole-pixel guesses without slopes, "
        f"to 5e-4 px: {iterations[0]:.1f} and {iterations[1]:.1f} iterations; images prepared; one thread",
    )
    settings, grid, search = MatchSettings(RADIUS), GridSettings(spacing=4), SearchSettings()
    whole = cpu_seconds(lambda: match_grid(images, pair[1], settings, grid, search), 3)
    nodes = sample_nodes(images.labels, grid.spacing)
    seeds = choose_seeds(images.labels, nodes.x, nodes.y, search)
    seeding = cpu_seconds(
        lambda: seed_displacements(pair[0], pair[1], images.labels, nodes.x[seeds], nodes.y[seeds], search),
        3,
    )
    yield Figure("seed_share_of_correlation", seeding / whole, "1", 1.0 / 3.0, "at most")
    yield Figure("grid_r16_points_per_cpu_s", len(nodes.x) / whole, "points / CPU-s")
    yield Condition(
        "seed_share",
        f"{len(seeds)} seeds within +-{search.range_x} px each way, then {len(nodes.x)} points "
        f"{grid.spacing} px apart, from neighbour to neighbour, outliers removed; one thread",
    )


def _every_pixel(run: Run) -> Iterator[Found]:
    if run.quick:
        yield Figure("every_pixel_1mpx_wall_s", None, "s", 45.0, "at most")
        yield Condition("every_pixel", "left out: --quick")
        return
    run.say("dic: every pixel of a 1-megapixel state")
    pair = stretched(1024)
    settings, grid = MatchSettings(RADIUS), GridSettings(spacing=1)
    started, used = time.perf_counter(), time.process_time()
    images = labelled(*pair, noise=_NOISE)
    found = match_grid(images, pair[1], settings, grid, SearchSettings(), run.threads)
    taken, spent = time.perf_counter() - started, time.process_time() - used
    part = float((found.matches.ending == CONVERGED).mean())
    yield Figure("every_pixel_1mpx_wall_s", taken, "s", 45.0, "at most")
    yield Condition(
        "every_pixel",
        f"1024 x 1024 points, {part:.1%} matched, first order, radius {RADIUS} px, with splines and seeds; "
        f"{run.threads} threads, {spent:.0f} CPU-s",
    )


def _accuracy(run: Run) -> Iterator[Found]:
    run.say("dic: bias and scatter")
    size = 192
    x, y = places(size, 24, 4)
    bias, scatter = [], []
    shifts = (0.1, 0.25, 0.5, 0.75, 0.9)
    for k, u in enumerate(shifts):
        truth = np.tile([u, -u], (len(x), 1))
        error, _ = errors(labelled(*speckle_pair(size, shift(u, -u), 10 + k)), Points(x, y, truth), 1)
        bias.append(np.abs(error.mean(axis=0)).max())
        scatter.append(error.std(axis=0).max())
    yield Figure("rigid_shift_bias_px", float(max(bias)), "px", 5e-4, "at most")
    yield Figure("rigid_shift_sigma_px", float(max(scatter)), "px", 5e-4, "at most")
    yield Condition(
        "rigid_shift",
        "exact speckle of blobs of 1.8 px, no noise, no rounding, shifted by "
        f"{', '.join(map(str, shifts))} px along x and back along y; "
        f"first order, radius {RADIUS} px, {len(x)} points; the worst shift",
    )
    yield from _interpolants(x, y, size)
    field = quadratic(size, _CURVATURE)
    truth = np.stack(field(x.astype(np.float64), y.astype(np.float64)), axis=1)
    images = labelled(*speckle_pair(size, field, 20))
    for order, limit in ((1, None), (2, 1e-3)):
        rms = float(np.sqrt(np.mean(errors(images, Points(x, y, truth), order)[0] ** 2)))  # type: ignore[arg-type]
        yield Figure(f"quadratic_rms_order{order}_px", rms, "px", limit, "at most")
    yield Condition(
        "quadratic",
        f"the same without noise, every second derivative of u and v +-{_CURVATURE:g} / px: first order "
        "finds the mean over its subset, second order the middle",
    )
    yield from _honesty(run)


def _interpolants(x: Ints, y: Ints, size: int) -> Iterator[Found]:
    truth = np.tile([0.25, -0.25], (len(x), 1))
    pair = speckle_pair(size, shift(0.25, -0.25), 11)
    others: tuple[Interpolant, ...] = ("cubic", "local-cubic")
    for other in others:
        images = prepare_images(*pair, np.ones((size, size), np.int32), interpolant=other)
        bias = float(np.abs(errors(images, Points(x, y, truth), 1)[0].mean(axis=0)).max())
        yield Figure(f"rigid_shift_bias_{other.replace('-', '_')}_px", bias, "px")
    images = labelled(*pair)
    found = REFINEMENT["fourier-newton"](images, x, y, np.zeros((len(x), 6)), MatchSettings(RADIUS))
    bias = float(np.abs((found.warp[:, [0, 3]] - truth).mean(axis=0)).max())
    yield Figure("rigid_shift_bias_fourier_newton_px", bias, "px")
    yield Condition(
        "interpolants",
        "the same shifted by 0.25 px, by other interpolants than the quintic, the local cubic being that of "
        "other programs; and by the thesis's peak of the cross-correlation, which wants none",
    )


def _honesty(run: Run) -> Iterator[Found]:
    size, repeats = 192, 4 if run.quick else 20
    x, y = places(size, 24, 2 * RADIUS + 1)
    truth = np.tile([0.37, -0.21], (len(x), 1))
    pair = speckle_pair(size, shift(0.37, -0.21), 30)
    rng = np.random.default_rng(31)
    orders: tuple[ShapeOrder, ...] = (0, 1, 2)
    ratio = {order: np.zeros(0) for order in orders}
    for _ in range(repeats):
        noisy = [image + rng.normal(0.0, 2.0 * _NOISE, image.shape) for image in pair]
        images = labelled(noisy[0], noisy[1], 2.0 * _NOISE)
        for order in orders:
            error, sigma = errors(images, Points(x, y, truth), order)
            ratio[order] = np.append(ratio[order], error / sigma)
    honest = {order: float(1.0 / np.sqrt(np.mean(r * r))) for order, r in ratio.items()}
    yield Figure("sigma_reported_over_observed", honest[1], "1", 1.2, "at most")
    yield Figure("sigma_reported_over_observed_order0", honest[0], "1", 1.2, "at most")
    yield Figure("sigma_reported_over_observed_order2", honest[2], "1", 1.2, "at most")
    yield Condition(
        "sigma",
        f"{len(ratio[1])} errors of subsets that do not overlap, noise of {2.0 * _NOISE / 400.0:.0%} of the "
        "contrast in both images; wanted between 0.8 and 1.2; first order where nothing is said",
    )


def _edges(run: Run) -> Iterator[Found]:
    run.say("dic: the half-and-half subset")
    found = {parted: match_halves(parted=parted, radius=RADIUS) for parted in (True, False)}
    near = np.abs(found[True].distance) < RADIUS
    for parted, name in ((True, ""), (False, "_without_regions")):
        value = float(np.sqrt(np.mean(found[parted].rms()[near] ** 2)))
        yield Figure(f"half_and_half_rms{name}_px", value, "px", 0.01 if parted else None, "at most")
    for parted, name in ((True, ""), (False, "_without_regions")):
        width = float(np.count_nonzero(found[parted].rms() > _EDGE_ERROR))
        yield Figure(f"edge_width{name}_px", width, "px", 1.0 if parted else None, "at most")
    yield Condition(
        "half_and_half",
        f"thesis Fig. 35-37: halves of one image move along x by {HALVES[0]} .. {HALVES[-1]} px, no noise, "
        f"first order, radius {RADIUS} px, within {RADIUS} px of the edge; of the points, "
        f"{found[True].found().mean():.1%} converge with regions and {found[False].found().mean():.1%} "
        "without; thesis 0.05 px",
    )
    yield Condition(
        "edge_width",
        f"rows about that edge whose rms error is above {_EDGE_ERROR} px",
    )


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    yield from _speed(run)
    yield from _every_pixel(run)
    yield from _accuracy(run)
    yield from _edges(run)


GROUP = Group("dic", "speed, bias and scatter of matching image subsets", warm_up, measure)
