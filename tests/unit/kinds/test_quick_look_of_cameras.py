"""A quick look at what two cameras have recorded without a projector: the truth within what it states."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from functools import cache

import numpy as np
import pytest
from support.two_cameras import VOLUME, Floats, Height, Motion, at_rest, cameras, curved, flat, seen_by

from sms_jobs.kinds.deformation.quick_look import KIND, Compared, QuickLookParameters
from sms_jobs.kinds.kind import DatasetOutput, Inputs
from sms_jobs.kinds.shape.plane import PlaneParameters
from sms_jobs.kinds.shape.stereo_parameters import StereoParameters
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.quick_look import QuickLook
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import Role
from sms_jobs.testing.in_memory import InMemory

AT = datetime(2026, 5, 4, tzinfo=UTC)
NOISE = 20.0
GAUGES = {
    "g1 x=0 y=0 length=40": (0.0, 0.0, 40.0, 0.0),
    "g2 x=20 y=-10 length=30 angle=90": (20.0, -10.0, 30.0, 90.0),
    "g3 x=-15 y=8 length=20 angle=45": (-15.0, 8.0, 20.0, 45.0),
    "off x=300 y=0 length=10": (300.0, 0.0, 10.0, 0.0),
}
ON = 3
"""How many of them lie on the specimen."""


def stretched(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    return 0.3 + 2e-3 * x, -0.1 - 5e-4 * y, 0.5 + 1e-3 * x


@cache
def calibration() -> Calibration:
    sensors = tuple(
        Sensor(f"C{k + 1}", Role.CAMERA, one.columns, one.rows, one.intrinsics, one.pose)
        for k, one in enumerate(cameras())
    )
    return Calibration(Rig("two", sensors), Box(*VOLUME), AT, "exact")


@cache
def levels(height: Height, motion: Motion, number: int) -> Floats:
    return seen_by(cameras()[number], height, motion).levels


def recorded(height: Height, motion: Motion, number: int, seed: int) -> Measurement:
    random = np.random.default_rng((seed, number, motion is stretched))
    clean = levels(height, motion, number)
    noisy = np.clip(np.rint(clean + random.normal(0.0, NOISE, clean.shape)), 0, 4095).astype(np.uint16)
    return Measurement(AT, FringeSequence(), 4095, 0.0, NOISE, noisy, ArrayStack(noisy[None]))


def looked_at(height: Height, motion: Motion, seed: int, rest: DatasetOutput | None = None) -> DatasetOutput:
    subject = Subject("test", "S00" if rest is None else "S01", "C1C2")
    datasets = {
        f"measurement {own}": InMemory(own, {"measurement": recorded(height, motion, k, seed)})
        for k, own in enumerate(subject.recordings)
    }
    datasets["calibration"] = InMemory(subject, {"calibration": calibration()})
    if rest is not None:
        before = replace(subject, state="S00")
        frames = {"measurement": recorded(height, at_rest, 0, seed)}
        datasets["reference"] = InMemory(before, rest.records)
        datasets["reference_measurement"] = InMemory(before.recordings[0], frames)
    at_origin = Pose.from_arrays(np.eye(3), np.zeros(3))
    compared = Compared("S00", tuple(GAUGES), at_origin, StereoParameters(), PlaneParameters())
    told: list[float] = []
    inputs = Inputs(subject, compared, datasets)
    (output,) = KIND.run(inputs, QuickLookParameters(), lambda fraction, message="": told.append(fraction))
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert isinstance(output, DatasetOutput)
    KIND.checked(output)
    return output


def grown(height: Height, gauge: str) -> float:
    """Return by how much the distance of a gauge's ends grows."""
    x, y, length, angle = GAUGES[gauge]
    half = 0.5 * length * np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))])
    middle = np.array([x, y])
    ends = np.array([middle - half, middle + half]).T
    before = np.stack([*ends, height(*ends)])
    after = before + np.stack(stretched(*ends))
    long, short = (float(np.linalg.norm(one[:, 1] - one[:, 0])) for one in (after, before))
    return long - short


@pytest.mark.parametrize("height", [flat, curved])
def test_gauges_read_what_is_true_within_what_they_state(height: Height) -> None:
    scores = []
    for seed in range(3):
        output = looked_at(height, stretched, seed, looked_at(height, at_rest, seed))
        look = output.records["look"]
        assert isinstance(look, QuickLook)
        assert look.doubts == ()
        assert list(look.reason) == [Reason.VALID] * ON + [Reason.TOO_FEW_NEIGHBOURS]
        for k, gauge in enumerate(tuple(GAUGES)[:ON]):
            true = np.stack(stretched(look.place[k, :1], look.place[k, 1:2]))[:, 0]
            scores += list((look.displacement[k] - true) / look.sigma[k])
            scores.append((look.extension[k] - grown(height, gauge)) / look.extension_sigma[k])
        # A shape is known to 0.005 mm, 0.006 px of 0.25 mm over the sine of 20 degrees; two make 0.007.
        assert np.all(look.sigma[:ON] < 0.01)
    rms = float(np.sqrt(np.mean(np.square(scores))))
    assert np.max(np.abs(scores)) < 4.5, scores
    # 0.9 in 72 gauges of 24 pairs of states: those along the baseline are stated 1.6 times too large, since
    # the reference camera's noise moves the shape and the match in time together. 36 numbers, half of them
    # independent at the worst, scatter by 0.15 about that.
    assert 0.45 < rms < 1.3, rms


def test_the_shape_is_that_of_every_few_pixels() -> None:
    output = looked_at(curved, at_rest, 0)
    surface = output.records["surface"]
    x, y, z = surface.position
    valid = surface.reason == Reason.VALID
    # A rim of 10 px, beyond which no subset has its points, is 11 % of the image.
    assert valid.mean() > 0.85
    sigma = np.sqrt(surface.covariance[[0, 3, 5]].sum(axis=0))
    off = np.abs(z - curved(x, y))[valid]
    # 0.67 for normal errors; 190 subsets beside each other tell the median to 0.06.
    assert 0.44 < np.median(off / sigma[valid]) < 0.9
    assert output.statistics["gauges_read"] == 0.0
