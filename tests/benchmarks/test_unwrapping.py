"""Speed of unwrapping and triangulation; run with `pytest --benchmark-only`, never part of the suite."""

from __future__ import annotations

from math import pi

import numpy as np
from pytest_benchmark.fixture import BenchmarkFixture

from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.triangulation import Projector, camera_rays, triangulate
from sms_jobs.metrology.phase.patterns import phase_gradient
from sms_jobs.metrology.phase.temporal_unwrapping import unwrap

DENSITIES = (32, 31, 30, 28, 24, 16)
ROWS, COLUMNS = 512, 1024


def test_unwrapping_of_24_frames(benchmark: BenchmarkFixture, rng: np.random.Generator) -> None:
    omega = rng.uniform(-pi, pi, size=(ROWS, COLUMNS))
    frames = np.array(
        [
            np.rint(1500.0 + 1000.0 * np.cos(omega * t + pi / 2.0 * k)).astype(np.uint16)
            for t in DENSITIES
            for k in range(4)
        ]
    )
    benchmark(unwrap, frames, DENSITIES, 4, full_scale=4095, gain=0.1, read_noise=3.0)
    benchmark.extra_info["Mpx x frames per second"] = frames.size / benchmark.stats["min"] / 1e6


def test_triangulation(benchmark: BenchmarkFixture) -> None:
    up = np.array([0.0, -1.0, 0.0])
    lens = Intrinsics(1400.0, 1400.0, 511.5, 255.5, -0.05, 0.02, 1e-3, -1e-3)
    pose = Pose.looking_at(np.array([-400.0, 0.0, -1000.0]), np.zeros(3), up)
    projector = Projector(lens, Pose.looking_at(np.array([400.0, 0.0, -1000.0]), np.zeros(3), up), 1024, 768)
    rays = camera_rays(lens, pose, ROWS, COLUMNS)
    pixels = project(lens, projector.pose, pose.centre() + 1070.0 * rays)
    omega = np.stack([phase_gradient(pixels, 1024, 768, a) for a in (0.0, pi / 2)])
    sigma = np.full(omega.shape, 2e-4, np.float32)
    benchmark(triangulate, pose.centre(), rays, projector, (0.0, pi / 2), omega, sigma)
