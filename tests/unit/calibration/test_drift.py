"""Whether a calibration still holds, from the ray gap of a measurement."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.calibration.checking.drift import (
    CHANGES,
    DriftCheck,
    DriftOptions,
    check_drift,
    pair_changes,
)
from sms_jobs.metrology.calibration.checking.gap_blocks import block_gaps
from sms_jobs.metrology.calibration.pair_points import Parameters, meet_rays, moved_sensor
from sms_jobs.metrology.calibration.sensor_derivatives import gap_derivatives
from sms_jobs.metrology.geometry.camera import PER_SENSOR, Pose, pixel_grid, project, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.triangulation import Projector, camera_rays, triangulate

Floats = NDArray[np.float64]

DOWN = np.array([0.0, -1.0, 0.0])
CAMERA: Parameters = (
    Intrinsics(1500.0, 1500.0, 511.5, 383.5, -0.1, 0.05),
    Pose.looking_at(np.array([-300.0, 0.0, -1000.0]), np.zeros(3), DOWN),
)
PROJECTOR: Parameters = (
    Intrinsics(1400.0, 1405.0, 500.0, 420.0, 0.05, -0.02, 1e-4, -2e-4),
    Pose.looking_at(np.array([300.0, 50.0, -1050.0]), np.zeros(3), DOWN),
)
BASE = float(np.linalg.norm(CAMERA[1].centre() - PROJECTOR[1].centre()))
PLAUSIBLE = 1e-3 * np.array([1.0, 1.0, 1.0, BASE, BASE, 1.0, 1.0])

ROWS, COLUMNS, STEP = 192, 256, 4.0
SIGMA_PX = 0.05


@dataclass(frozen=True)
class Measurement:
    gap: Floats
    sigma: Floats
    xyz: Floats


@cache
def surface() -> Floats:
    """Return the points (n, 3) of a wavy, tilted surface behind every fourth pixel of the camera."""
    rays = ray_directions(*CAMERA, pixel_grid(ROWS, COLUMNS).reshape(-1, 2) * STEP)
    centre = CAMERA[1].centre()
    along = np.full(len(rays), 1000.0)
    for _ in range(60):  # fixed point; that it is not quite settled only makes another surface
        p = centre + along[:, None] * rays
        z = 60.0 * np.sin(p[:, 0] / 70.0) + 50.0 * np.cos(p[:, 1] / 60.0) + 0.1 * p[:, 0]
        along += 0.5 * (z - p[:, 2]) / rays[:, 2]
    return np.asarray(centre + along[:, None] * rays)


@cache
def by_change() -> Floats:
    """Return how the parameters of the pair change with what a check tells of them."""
    return pair_changes(CAMERA, PROJECTOR, surface().mean(axis=0))


def measure(
    rng: np.random.Generator, change: Floats | None = None, sigma_px: float = SIGMA_PX
) -> Measurement:
    """Measure the surface after the pair has changed, (2 parameters,), with the calibration from before."""
    step = np.zeros(2 * PER_SENSOR) if change is None else change
    seen = project(*moved_sensor(CAMERA, step[:PER_SENSOR]), surface())
    lit = project(*moved_sensor(PROJECTOR, step[PER_SENSOR:]), surface())
    noisy = lit + sigma_px * rng.standard_normal(lit.shape)
    xyz, gap = meet_rays(CAMERA, PROJECTOR, seen, noisy)
    slopes = [
        (meet_rays(CAMERA, PROJECTOR, seen, lit + d)[1] - meet_rays(CAMERA, PROJECTOR, seen, lit - d)[1])
        / 0.2
        for d in np.array([[0.1, 0.0], [0.0, 0.1]])
    ]
    sigma = max(sigma_px, 1e-9) * np.hypot(*slopes)
    image = (ROWS, COLUMNS)
    return Measurement(gap.reshape(image), sigma.reshape(image), xyz.T.reshape(3, *image))


def check(found: Measurement, **more: Any) -> DriftCheck:
    more.setdefault("gap_sigma", found.sigma)
    return check_drift(found.gap, found.xyz, CAMERA, PROJECTOR, **more)


def test_gap_derivatives_are_those_of_finite_differences(rng: np.random.Generator) -> None:
    points = rng.uniform(-150.0, 150.0, (20, 3))
    pixels = (project(*CAMERA, points), project(*PROJECTOR, points))
    found = gap_derivatives(CAMERA, PROJECTOR, points)
    for k in range(2 * PER_SENSOR):
        size = 1e-6 if k % PER_SENSOR < 3 else 1e-3 if k % PER_SENSOR < 10 else 1e-5
        step = size * np.eye(2 * PER_SENSOR)[k]
        up, down = (
            meet_rays(
                moved_sensor(CAMERA, s * step[:PER_SENSOR]),
                moved_sensor(PROJECTOR, s * step[PER_SENSOR:]),
                *pixels,
            )[1]
            for s in (1, -1)
        )
        # Gaps of 1e-3 mm and more, rounding of 1e-12 mm; second-order terms cancel.
        largest = np.abs(found[:, k]).max()
        np.testing.assert_allclose(found[:, k], (up - down) / (2 * size), rtol=1e-5, atol=1e-6 * largest)


def test_a_calibration_that_holds_is_said_to_hold(rng: np.random.Generator) -> None:
    found = check(measure(rng))
    assert found.verdict == "holds"
    assert found.blocks == 48
    # 49 152 pixels of 0.05 px = 0.035 mm: about 0.035 / sqrt(49152) sqrt(45) = 1.1 um for equal weights.
    assert found.detectable_rms_mm < 0.002
    assert found.gap_rms_mm < 0.001


def test_a_turn_of_100_microradians_is_found_and_explained(rng: np.random.Generator) -> None:
    # About the projector's x axis, which is nearly along the base: a gap of 1e-4 x 1 m = 0.1 mm everywhere.
    found = check(measure(rng, by_change()[:, 0] * 1e-4))
    assert found.verdict == "drifted"
    assert found.motion_statistic > 100.0 * found.motion_threshold
    assert found.rest_statistic < found.rest_threshold
    assert found.gap_rms_mm == pytest.approx(0.1, rel=0.15)  # distances of 0.95 to 1.15 m
    assert found.explained > 0.99
    turn = found.changes[0]
    assert turn.name == CHANGES[0]
    assert turn.determined
    # Four deviations, and a tenth for what other changes share of the pattern where they are hardly told.
    assert abs(turn.value - 1e-4) < 4.0 * turn.sigma + 1e-5


def test_the_explanation_scatters_as_predicted(rng: np.random.Generator) -> None:
    scores = []
    for _ in range(20):
        change = 0.1 * PLAUSIBLE * rng.standard_normal(7)
        found = check(measure(rng, by_change() @ change))
        scores += [
            (c.value - v) / c.sigma for c, v in zip(found.changes, change, strict=True) if c.determined
        ]
    # 60 scores and more are known to 9 %; what leaks in of directions that are not told, which count for up
    # to a tenth of a parameter that is called seen, only adds.
    assert len(scores) >= 60
    assert 0.75 < float(np.sqrt(np.mean(np.square(scores)))) < 1.5


def test_false_alarms_are_as_rare_as_stated(rng: np.random.Generator) -> None:
    still = measure(rng)
    alarms = 0
    for _ in range(200):
        gap = still.sigma * rng.standard_normal(still.sigma.shape)
        noisy = Measurement(gap, still.sigma, still.xyz)
        found = check(noisy, options=DriftOptions(false_alarm=0.1))
        alarms += found.verdict == "drifted"
    # 10 % or a little less, since variances of blocks are only ever enlarged, by 2 % on average: 17 to 20 of
    # 200, standard deviation 4.2.
    assert 17 - 3 * 4.2 < alarms < 20 + 3 * 4.2


@pytest.mark.parametrize("given", ["covariance", "baseline"])
def test_what_the_calibration_left_is_no_drift(given: str, rng: np.random.Generator) -> None:
    # The calibration itself is off by its covariance, a fiftieth of what is plausible of a drift.
    still = measure(rng)
    unit = 0.02 * PLAUSIBLE
    slow = gap_derivatives(CAMERA, PROJECTOR, surface()) @ by_change() * unit
    baseline = float(np.sqrt(np.mean(np.sum(slow**2, axis=1))))
    known = {
        "covariance": {"covariance": (by_change() * unit**2) @ by_change().T},
        "baseline": {"baseline_rms_mm": baseline},
    }[given]
    alarms, blind = 0, 0
    for _ in range(40):
        off = (slow @ rng.standard_normal(7)).reshape(ROWS, COLUMNS)
        noise = still.sigma * rng.standard_normal(still.sigma.shape)
        noisy = Measurement(off + noise, still.sigma, still.xyz)
        options = DriftOptions(false_alarm=0.05)
        alarms += check(noisy, options=options, **known).verdict == "drifted"
        blind += check(noisy, options=options).verdict == "drifted"
    # At most 5 %: 2 of 40, standard deviation 1.4. Without that knowledge nearly all are alarms.
    assert alarms <= 6
    assert blind > 36


def test_other_gap_patterns_are_drift_that_nothing_explains(rng: np.random.Generator) -> None:
    found = measure(rng)
    wave = 0.01 * np.sin(np.arange(COLUMNS) / 12.0)
    result = check(Measurement(found.gap + wave, found.sigma, found.xyz))
    assert result.verdict == "drifted"
    assert result.rest_statistic > result.rest_threshold
    # What no change explains makes the explanation as uncertain as it is large.
    excess = np.sqrt(result.rest_statistic / result.rest_freedom)
    assert excess > 5.0
    assert result.point_change_sigma_mm > 0.8 * excess * check(found).point_change_sigma_mm


def test_outliers_are_left_out_and_few_pixels_tell_nothing(rng: np.random.Generator) -> None:
    found = measure(rng)
    gap = found.gap.copy()
    wrong = rng.random(gap.shape) < 0.05
    gap[wrong] += rng.uniform(1.0, 30.0, int(wrong.sum()))
    result = check(Measurement(gap, found.sigma, found.xyz))
    assert result.verdict == "holds"
    assert result.outliers == pytest.approx(wrong.sum(), rel=0.01)  # all are 20 standard deviations off
    gap[:, 30:] = np.nan
    few = check(Measurement(gap, found.sigma, found.xyz), options=DriftOptions(block_px=64))
    assert few.verdict == "cannot tell"
    assert "12 are needed" in few.reason
    with pytest.raises(InvalidInput, match="not of one image"):
        check_drift(found.gap, found.xyz[:, :5], CAMERA, PROJECTOR)


def test_noise_may_be_taken_from_the_scatter(rng: np.random.Generator) -> None:
    found = measure(rng)
    stated = block_gaps(found.gap, found.xyz, found.sigma, 16)
    taken = block_gaps(found.gap, found.xyz, None, 16)
    # The median deviation of 256 pixels is known to 7 %; the mean over 192 blocks to 0.5 %, and either
    # variance is enlarged by a few per cent where the scatter is larger by chance.
    assert np.mean(taken.sigma / stated.sigma) == pytest.approx(1.0, abs=0.05)
    assert check(found, gap_sigma=None).verdict == "holds"


def test_points_move_as_the_explanation_says(rng: np.random.Generator) -> None:
    change = by_change() @ np.array([1e-4, 0.0, -2e-4, 0.0, 0.0, 0.0, 0.0])
    result = check(measure(rng, change, sigma_px=0.005))
    lit = project(*moved_sensor(PROJECTOR, change[PER_SENSOR:]), surface())
    wrong, _ = meet_rays(CAMERA, PROJECTOR, project(*CAMERA, surface()), lit)
    off = float(np.sqrt(np.mean(np.sum((wrong - surface()) ** 2, axis=1))))
    # The gap says nothing of what turns within the epipolar planes; the smallest change is nearly all here.
    assert result.point_change_rms_mm == pytest.approx(
        off, abs=4.0 * result.point_change_sigma_mm + 0.2 * off
    )


def test_rays_meet_where_the_kernel_says(rng: np.random.Generator) -> None:
    rows, columns = 12, 16
    omega = rng.uniform(-1.0, 1.0, (2, rows, columns))
    lens = Intrinsics(20.0, 20.0, 7.5, 5.5, -0.1)
    kernel = triangulate(
        CAMERA[1].centre(),
        camera_rays(lens, CAMERA[1], rows, columns),
        Projector(*PROJECTOR, 1024, 768),
        (0.0, 0.5 * np.pi),
        omega,
        np.full(omega.shape, 1e-3, np.float32),
    )
    lit = np.stack([omega[0] * 1024 / (2 * np.pi) + 511.5, omega[1] * 768 / (2 * np.pi) + 383.5], axis=-1)
    xyz, gap = meet_rays((lens, CAMERA[1]), PROJECTOR, pixel_grid(rows, columns), lit)
    some = np.isfinite(kernel.ray_gap)
    assert some.sum() > 50
    # The kernel stores gaps in single precision.
    np.testing.assert_allclose(gap[some], kernel.ray_gap[some], rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(xyz[some], np.moveaxis(kernel.xyz, 0, -1)[some], rtol=1e-9, atol=1e-7)
