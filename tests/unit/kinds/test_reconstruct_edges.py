"""Pixels on silhouettes and rims of light, against the exact truth of 8 x 8 rays a pixel."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.bench.fringes.plate_before_wall import random_scene, reconstructed, record
from sms_jobs.kinds.shape.reconstruct import ReconstructParameters
from sms_jobs.records.gray_code import GrayCode
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.reasons import Reason

UNWRAPPED = (FringeSequence((16, 15, 14, 12, 8)), ReconstructParameters())
RANGED = (FringeSequence(tuple(range(12))), ReconstructParameters(method="fdr"))
CODED = (FringeSequence((16,), 4, (0.0,), gray=GrayCode(5, (32.0,))), ReconstructParameters())
PAIRED = (FringeSequence(tuple(range(20))), ReconstructParameters(method="fdr", returns=2))


@pytest.mark.parametrize(
    ("seed", "how"),
    [(0, UNWRAPPED), (6, UNWRAPPED), (1011, UNWRAPPED), (3, RANGED), (1000, PAIRED), (1, CODED)],
)
def test_no_mixed_pixel_is_far_off_and_good_ones_stay(
    seed: int, how: tuple[FringeSequence, ReconstructParameters]
) -> None:
    seen = record(random_scene(np.random.default_rng(seed)), how[0])
    cloud = reconstructed(seen, how[1])
    sigma = np.sqrt(cloud.covariance[[0, 3, 5]].sum(axis=0))
    error = seen.error(cloud.position)
    valid = cloud.reason == Reason.VALID
    assert (valid & seen.mixed).any()
    assert not (valid & (error > 1.0) & (error > 10.0 * sigma)).any()
    between = cloud.reason & Reason.BETWEEN_SURFACES != 0
    assert (between & seen.mixed).any()
    assert (between & ~seen.mixed).sum() < 0.001 * (valid & ~seen.mixed).sum()
