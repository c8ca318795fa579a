"""The choice among candidate pairs: it finds the direct light, and says where it cannot."""

from __future__ import annotations

from itertools import product
from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.ray_pairing import CandidateReturns, Pairing, PairingRule, choose_returns
from sms_jobs.metrology.geometry.triangulation import Projector, camera_rays, triangulate
from sms_jobs.metrology.phase.patterns import direction, phase_gradient, span_px

Floats = NDArray[np.float64]

ROWS, COLUMNS = 20, 26
UP = np.array([0.05, -1.0, 0.0])
CAMERA = Intrinsics(45.0, 46.0, 12.3, 9.8, -0.08, 0.05, 4e-4, -3e-4, 0.01)
CAMERA_POSE = Pose.looking_at(np.array([-400.0, 30.0, -1000.0]), np.zeros(3), UP)
PROJECTOR = Projector(
    Intrinsics(1900.0, 1890.0, 515.0, 390.0, -0.05, 0.03, -2e-4, 3e-4, 0.0),
    Pose.looking_at(np.array([420.0, -80.0, -1100.0]), np.array([5.0, 0.0, 0.0]), UP),
    1024,
    768,
)
CROSSED = (0.0, pi / 2)
SIGMA = 3e-5  # rad: s = 64 and B = 50 sigma
DENSITY_RMS = 36.0  # of 0 .. 63
EVERYWHERE = ((-1e4, -1e4, -1e4), (1e4, 1e4, 1e4))
RAYS = camera_rays(CAMERA, CAMERA_POSE, ROWS, COLUMNS)


def at_distance(distance: Floats) -> Floats:
    """Return the points at a distance (rows, columns) along the camera's rays."""
    return np.asarray(CAMERA_POSE.centre() + distance[..., None] * RAYS)


def phases(points: Floats, orientations: tuple[float, ...]) -> Floats:
    pixels = project(PROJECTOR.intrinsics, PROJECTOR.pose, points)
    return np.stack([phase_gradient(pixels, PROJECTOR.columns, PROJECTOR.rows, a) for a in orientations])


def choose(
    omega: Floats,
    amplitude: Floats,
    orientations: tuple[float, ...] = CROSSED,
    volume: tuple[tuple[float, float, float], tuple[float, float, float]] = EVERYWHERE,
    floor: float = 0.01,
    least_gap: bool = False,
    threads: int = 1,
    peak: float = 0.0,
) -> Pairing:
    return choose_returns(
        CAMERA_POSE.centre(),
        RAYS,
        PROJECTOR,
        orientations,
        CandidateReturns(omega, np.full(omega.shape, SIGMA, np.float32), amplitude.astype(np.float32)),
        PairingRule(*volume, floor, DENSITY_RMS, peak, least_gap),
        threads=threads,
    )


def lit_twice(
    rng: np.random.Generator, orientations: tuple[float, ...] = CROSSED
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return omega and amplitude (orientations, 2, rows, columns) and which return is the direct one.

    The detour comes from anywhere in the projector; the order of the returns is drawn for each orientation.
    """
    direct = phases(at_distance(rng.uniform(1000.0, 1100.0, (ROWS, COLUMNS))), orientations)
    pixels = rng.uniform(100.0, 650.0, (ROWS, COLUMNS, 2))
    detour = np.stack([phase_gradient(pixels, PROJECTOR.columns, PROJECTOR.rows, a) for a in orientations])
    strength = np.array([400.0, 240.0])[:, None, None] * rng.uniform(0.8, 1.2, (2, ROWS, COLUMNS))
    first = rng.integers(0, 2, (len(orientations), ROWS, COLUMNS))
    omega = np.stack([np.where(first == 0, direct, detour), np.where(first == 0, detour, direct)], axis=1)
    swapped = first[:, None] == np.arange(2)[None, :, None, None]
    amplitude = np.where(swapped, strength[0], strength[1])
    return omega + SIGMA * rng.standard_normal(omega.shape), amplitude, first


@pytest.mark.parametrize("orientations", [CROSSED, (pi / 4, -pi / 4), (0.0, pi / 3, 2 * pi / 3)], ids=str)
def test_direct_light_is_found_in_any_order_of_returns(
    rng: np.random.Generator, orientations: tuple[float, ...]
) -> None:
    omega, amplitude, first = lit_twice(rng, orientations)
    found = choose(omega, amplitude, orientations)
    wanted = np.ones((ROWS, COLUMNS), int)
    for which in first:
        wanted = (wanted - 1) * 2 + which + 1
    right = found.label == wanted
    certain = found.margin > 5.0
    # Of the detours, drawn over some 400 px, those within a few of the epipolar line are uncertain.
    assert certain.mean() > 0.95
    # A margin of 5 is odds of 150: of 520 pixels at most a few are wrong, and of those few are certain.
    assert right[certain].mean() > 0.995
    assert right.mean() > 0.98
    chosen = np.take_along_axis(omega, first[:, None], axis=1)[:, 0]
    np.testing.assert_array_equal(found.omega[:, right], chosen[:, right])
    np.testing.assert_array_equal(found.omega_sigma, np.float32(SIGMA))


def reference(
    omega: Floats, amplitude: Floats, orientations: tuple[float, ...], floor: float, volume: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return likelihood, gap, depth and its variance of each combination by plain triangulation of each.

    The last is that of one return which is spread: mean omega by amplitude, and no volume.
    """
    tables = []
    light = amplitude.astype(np.float32).astype(np.float64)
    spread_omega = np.sum(omega * light, axis=1) / light.sum(axis=1)
    spread_sigma = SIGMA * light.min(axis=1) / light.sum(axis=1)
    every = (*product(range(omega.shape[1]), repeat=len(orientations)), None)
    for which in every:
        if which is None:
            one, strength, exact = spread_omega, light.sum(axis=1), spread_sigma
        else:
            one = np.stack([omega[k, which[k]] for k in range(len(orientations))])
            strength = np.stack([light[k, which[k]] for k in range(len(orientations))])
            exact = np.full(one.shape, np.float64(np.float32(SIGMA)))
        sigma = exact.astype(np.float32)
        found = triangulate(CAMERA_POSE.centre(), RAYS, PROJECTOR, orientations, one, sigma)
        variance = floor**2 + found.ray_gap_sigma.astype(float) ** 2
        evidence = found.ray_gap.astype(float) ** 2 / variance + np.log(variance)
        weight = 1.0 / (0.15**2 + (DENSITY_RMS * exact) ** 2)
        logarithm = np.log(strength)
        mean = np.sum(weight * logarithm, axis=0) / weight.sum(axis=0)
        evidence += np.minimum(np.sum(weight * (logarithm - mean) ** 2, axis=0), 9.0)
        span = np.array([span_px(PROJECTOR.columns, PROJECTOR.rows, a) for a in orientations])
        matrix = np.array([direction(a) for a in orientations])
        pixels = np.linalg.lstsq(matrix, (one * span[:, None, None]).reshape(len(orientations), -1))[0]
        off = (matrix @ pixels / span[:, None]).reshape(one.shape) - one
        evidence += np.sum((off / exact) ** 2, axis=0)
        outside = ((found.xyz < volume[0][:, None, None]) | (found.xyz > volume[1][:, None, None])).any(
            axis=0
        ) & (which is not None)
        likelihood = np.where(np.isnan(found.ray_gap), -np.inf, -0.5 * evidence - 1e3 * outside)
        depth = np.sum((np.moveaxis(found.xyz, 0, -1) - CAMERA_POSE.centre()) * RAYS, axis=-1)
        tables.append((likelihood, np.abs(found.ray_gap), depth, found.covariance[[0, 3, 5]].sum(axis=0)))
    likelihood, gap, depth, deep = (np.stack(t) for t in zip(*tables, strict=True))
    return likelihood, gap, depth, deep


@pytest.mark.parametrize("peak", [0.0, 10.0])
@pytest.mark.parametrize("least_gap", [False, True])
@pytest.mark.parametrize("orientations", [CROSSED, (0.0, pi / 3, 2 * pi / 3)], ids=str)
def test_the_kernel_is_the_slow_reference(
    rng: np.random.Generator, orientations: tuple[float, ...], least_gap: bool, peak: float
) -> None:
    omega, amplitude, _ = lit_twice(rng, orientations)
    volume = np.array([[-1e4, -1e4, -60.0], [1e4, 1e4, 60.0]])
    found = choose(
        omega,
        amplitude,
        orientations,
        (tuple(volume[0]), tuple(volume[1])),
        floor=0.05,
        least_gap=least_gap,
        peak=peak,
    )
    likelihood, gap, depth, deep = reference(omega, amplitude, orientations, 0.05, volume)
    gap[-1] = np.inf  # what is spread is never chosen
    likelihood[-1] = likelihood[-1] if peak else -np.inf
    chosen_from = np.concatenate([likelihood[:-1], np.full_like(likelihood[-1:], -np.inf)])
    best = (
        np.argmin(np.where(np.isnan(gap), np.inf, gap), axis=0) if least_gap else chosen_from.argmax(axis=0)
    )
    np.testing.assert_array_equal(found.label, best + 1)
    index = best[None]
    of_best = [np.take_along_axis(t, index, axis=0) for t in (likelihood, depth, deep)]
    near = np.abs(depth - of_best[1]) <= 3.0 * np.sqrt(deep + of_best[2])
    others = np.where(near | (np.arange(len(gap))[:, None, None] == index), -np.inf, likelihood)
    # The triangulation's gap is a float32: 1e-7 of up to 100 mm over a floor of 0.05 mm, squared.
    np.testing.assert_allclose(found.margin, of_best[0][0] - others.max(axis=0), rtol=1e-4, atol=1e-2)


def test_order_brightness_and_threads_change_nothing(rng: np.random.Generator) -> None:
    omega, amplitude, _ = lit_twice(rng)
    found = choose(omega, amplitude)
    for other in (
        choose(omega[:, ::-1].copy(), amplitude[:, ::-1].copy()),
        choose(omega, 7.0 * amplitude),
        choose(omega, amplitude, threads=2),
    ):
        np.testing.assert_array_equal(other.omega, found.omega)
        # Logarithms of other numbers round differently.
        np.testing.assert_allclose(other.margin, found.margin, rtol=1e-4, atol=1e-4)


def test_amplitudes_decide_where_gaps_do_not(rng: np.random.Generator) -> None:
    # Two points of one camera ray, both met by their own light: the gaps are zero, crosswise too where the
    # epipolar lines lie along a row; the amplitudes tell the crosswise pairs from the true ones.
    near = phases(at_distance(np.full((ROWS, COLUMNS), 1000.0)), CROSSED)
    far = phases(at_distance(np.full((ROWS, COLUMNS), 1080.0)), CROSSED)
    omega = np.stack([near, far], axis=1)
    amplitude = np.broadcast_to(np.array([400.0, 200.0])[:, None, None], (2, 2, ROWS, COLUMNS)).copy()
    found = choose(omega, amplitude, floor=50.0)  # gaps tell nothing
    assert set(np.unique(found.label)) <= {1, 4}
    # Which of the two it is, nothing tells: a mirror image looks like this.
    assert found.margin.max() < 1.0
    low = (-1e4, -1e4, float(at_distance(np.full((ROWS, COLUMNS), 1040.0))[..., 2].max()))
    behind = choose(omega, amplitude, volume=(low, (1e4, 1e4, 1e4)))
    outside = at_distance(np.full((ROWS, COLUMNS), 1000.0))[..., 2] < low[2]
    inside = at_distance(np.full((ROWS, COLUMNS), 1080.0))[..., 2] > low[2]
    told = outside & inside
    assert told.any()
    assert (behind.label[told] == 4).all()
    assert (behind.margin[told] > 100.0).all()


def test_two_candidates_of_one_place_are_no_ambiguity() -> None:
    point = phases(at_distance(np.full((ROWS, COLUMNS), 1050.0)), CROSSED)
    omega = np.stack([point, point + 0.1 * SIGMA], axis=1)
    amplitude = np.full((2, 2, ROWS, COLUMNS), 300.0)
    assert np.isinf(choose(omega, amplitude).margin).all()


DIAGONAL = (pi / 4, -pi / 4)
BIN = 2.0 * pi / 64.0


def split(along: float, across: float) -> tuple[Floats, Floats]:
    """Return what looks like two equal returns, px of the projector to either side of a point's own light."""
    pixels = project(PROJECTOR.intrinsics, PROJECTOR.pose, at_distance(np.full((ROWS, COLUMNS), 1050.0)))
    off = np.array([along, across])
    both = [
        np.stack(
            [phase_gradient(pixels + side * off, PROJECTOR.columns, PROJECTOR.rows, a) for a in DIAGONAL]
        )
        for side in (-1.0, 1.0)
    ]
    return np.stack(both, axis=1), np.full((2, 2, ROWS, COLUMNS), 300.0)


def test_a_spread_return_is_not_taken_for_the_better_of_two(rng: np.random.Generator) -> None:
    # Light about one point of the projector's image, along the epipolar lines but for a hundredth: both ends
    # have gaps within a few deviations, of which noise makes one the likelier.
    omega, amplitude = split(3.0, 0.03)
    omega = omega + SIGMA * rng.standard_normal(omega.shape)
    sharp, spread = (choose(omega, amplitude, DIAGONAL, floor=0.02, peak=p) for p in (0.0, 1.6 * BIN))
    assert (sharp.margin > 3.0).mean() > 0.2
    assert (spread.margin < 3.0).all()
    np.testing.assert_array_equal(spread.label, sharp.label)
    # Its middle counts outside the volume, too: what lies within for being wrong must not be trusted.
    depth = at_distance(np.full((ROWS, COLUMNS), 1050.0))[..., 2].min()
    cut = ((-1e4, -1e4, -1e4), (1e4, 1e4, float(depth)))
    assert (choose(omega, amplitude, DIAGONAL, cut, floor=0.02, peak=1.6 * BIN).margin < 3.0).all()


def test_two_close_returns_are_told_from_one_that_is_spread_by_the_gap(rng: np.random.Generator) -> None:
    # Direct light and a detour, 6 px across the epipolar lines: half way between them the rays miss.
    omega, amplitude = split(0.0, 3.0)
    omega = omega - omega[:, :1] + split(0.0, 0.0)[0] + SIGMA * rng.standard_normal(omega.shape)
    found = choose(omega, amplitude, DIAGONAL, floor=0.02, peak=1.6 * BIN)
    assert (found.label == 1).all()
    assert (found.margin > 3.0).all()


def test_a_single_return_needs_no_choice_and_none_has_no_label() -> None:
    point = phases(at_distance(np.full((ROWS, COLUMNS), 1050.0)), CROSSED)
    omega = np.stack([point, np.full_like(point, np.nan)], axis=1)
    omega[0, 0, 0, 0] = np.nan
    found = choose(omega, np.where(np.isnan(omega), np.nan, 300.0))
    assert found.label[0, 0] == 0
    assert np.isnan(found.omega[0, 0, 0])
    assert (found.label.ravel()[1:] == 1).all()
    assert np.isinf(found.margin).all()
    np.testing.assert_array_equal(found.omega[:, 1:], point[:, 1:])


def test_of_one_orientation_the_volume_alone_decides() -> None:
    near, far = (phases(at_distance(np.full((ROWS, COLUMNS), d)), (0.0,)) for d in (1000.0, 1080.0))
    omega = np.stack([near, far], axis=1)
    amplitude = np.broadcast_to(np.array([400.0, 200.0])[:, None, None], (1, 2, ROWS, COLUMNS)).copy()
    found = choose(omega, amplitude, (0.0,))
    assert (found.label == 1).all()  # the stronger
    assert (found.margin == 0.0).all()
    limit = float(at_distance(np.full((ROWS, COLUMNS), 1000.0))[..., 2].max()) + 1e-3
    behind = choose(omega, amplitude, (0.0,), ((-1e4, -1e4, limit), (1e4, 1e4, 1e4)))
    inside = at_distance(np.full((ROWS, COLUMNS), 1080.0))[..., 2] > limit
    assert inside.any()
    assert (behind.label[inside] == 2).all()
    assert (behind.margin[inside] > 100.0).all()


def test_too_many_combinations_and_parallel_fringes_are_refused() -> None:
    many = tuple(0.3 * k for k in range(7))
    with pytest.raises(InvalidInput, match="16384 combinations"):
        choose(np.zeros((7, 4, ROWS, COLUMNS)), np.ones((7, 4, ROWS, COLUMNS)), many)
    with pytest.raises(InvalidInput, match="parallel"):
        choose(np.zeros((2, 2, ROWS, COLUMNS)), np.ones((2, 2, ROWS, COLUMNS)), (0.5, 0.5))
