"""Boards of the SLStudio project's example data: real fringes of 3 steps, 16 and 1 across the projector."""

from __future__ import annotations

from math import pi
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.triangulation import Projector, camera_rays, triangulate
from sms_jobs.metrology.phase.temporal_unwrapping import unwrap

FOLDER = Path(__file__).resolve().parents[4] / "shared" / "data" / "fringe" / "slstudio_skull"

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason=f"put the published fringe images into {FOLDER} for these tests"
)

ROWS, COLUMNS = 1352, 1688
NEAR_MM = 1.5


def intrinsics(matrix: NDArray[np.float64], distortion: NDArray[np.float64]) -> Intrinsics:
    return Intrinsics(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel())


def board_plane(points: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the distances in mm of points (n, 3) from the plane that most of them are near to."""
    some = points[rng.integers(0, len(points), 20_000)]
    best: tuple[int, NDArray[np.float64], NDArray[np.float64]] = (0, np.zeros(3), np.zeros(3))
    for _ in range(300):
        a, b, c = some[rng.integers(0, len(some), 3)]
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal) + 1e-12
        near = int((np.abs((some - a) @ normal) < NEAR_MM).sum())
        if near > best[0]:
            best = (near, a, normal)
    _, origin, normal = best
    for _ in range(5):
        near_points = points[np.abs((points - origin) @ normal) < NEAR_MM]
        origin = near_points.mean(axis=0)
        normal = np.linalg.eigh(np.cov((near_points - origin).T))[1][:, 0]
    return np.asarray((points - origin) @ normal)


@pytest.mark.parametrize("sequence", ["calseq1", "calseq2", "calseq3"])
def test_a_flat_board_is_flat(sequence: str, rng: np.random.Generator) -> None:
    stored = cv2.FileStorage(str(FOLDER / "calibration.xml"), cv2.FILE_STORAGE_READ)
    kc, dc, kp, dp, turn, shift = (
        np.asarray(stored.getNode(n).mat(), float) for n in ("Kc", "kc", "Kp", "kp", "Rp", "Tp")
    )
    names = [FOLDER / sequence / f"frameSeq_{i:02d}.png" for i in range(12)]
    frames = np.stack([cv2.imread(str(name), cv2.IMREAD_GRAYSCALE) for name in names])
    # Their step k adds -2 pi k / 3 to the phase, and phase 0 is at the projector's edge, where omega is -pi.
    found = [
        unwrap(
            frames[first + np.array([0, 2, 1, 3, 5, 4])],
            (16, 1),
            3,
            full_scale=255,
            gain=0.05,
            read_noise=1.0,
        )
        for first in (0, 6)
    ]
    omega = np.stack([np.angle(np.exp(1j * (f.omega - pi))) for f in found])
    points = triangulate(
        np.zeros(3),
        camera_rays(intrinsics(kc, dc), Pose.from_arrays(np.eye(3), np.zeros(3)), ROWS, COLUMNS),
        Projector(intrinsics(kp, dp), Pose.from_arrays(turn, shift.ravel()), 1824, 1140),
        (0.0, pi / 2),
        omega,
        np.stack([f.omega_sigma for f in found]),
    )
    good = np.logical_and.reduce([(f.modulation > 10.0) & ~f.ambiguous & ~f.saturated for f in found])
    good &= np.isfinite(points.ray_gap)
    off = board_plane(points.xyz[:, good].T, rng)
    board = np.abs(off) < NEAR_MM
    assert board.sum() > 200_000
    # Plain decoding and triangulation gives 0.19-0.33 mm on these boards, and gaps of 0.31-0.56 mm.
    rms, gap = (np.sqrt(np.mean(np.square(v[board], dtype=float))) for v in (off, points.ray_gap[good]))
    assert rms < 0.33
    assert gap < 0.56
