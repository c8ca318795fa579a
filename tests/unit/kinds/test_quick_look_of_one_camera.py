"""A quick look at what a camera alone has recorded: gauges in the plane of its image."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.deformation.quick_look import KIND, Compared, QuickLookParameters
from sms_jobs.kinds.kind import DatasetOutput, Inputs
from sms_jobs.kinds.shape.plane import PlaneParameters
from sms_jobs.kinds.shape.stereo_parameters import StereoParameters
from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.quick_look import QuickLook
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import AT_ORIGIN
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory

AT = datetime(2026, 5, 4, tzinfo=UTC)
ROWS, COLUMNS, NOISE, SIZE_MM = 240, 320, 12.0, 0.1
SPECIMEN = slice(40, 200)  # rows: above and below is plain background
GAUGES = {
    "g1 x=160px y=120px length=100px": (160.0, 120.0, 100.0, 0.0),
    "g2 x=10mm y=12mm length=6mm angle=90": (100.0, 120.0, 60.0, 90.0),
    "g3 x=200px y=110px length=80px angle=30": (200.0, 110.0, 80.0, 30.0),
}
OFF = "off x=160px y=10px length=20px"
STRETCH = np.array([[1.004, 0.001], [-0.0005, 0.998]])  # of columns and rows, about the middle
SHIFT = np.array([1.3, -0.6])
MIDDLE = np.array([COLUMNS / 2.0, ROWS / 2.0])


def moved(place: Floats) -> Floats:
    """Return where places (..., 2) of the image at rest have come to, in px."""
    return np.asarray(MIDDLE + SHIFT + (place - MIDDLE) @ STRETCH.T)


def image(at_rest: bool, seed: int) -> np.ndarray:
    """Return a texture of waves of 5 to 20 px, exact wherever it is looked at, with noise."""
    waves = np.random.default_rng(7)
    y, x = np.mgrid[0:ROWS, 0:COLUMNS].astype(float)
    place = np.stack([x, y], axis=-1)
    if not at_rest:
        place = MIDDLE + (place - MIDDLE - SHIFT) @ np.linalg.inv(STRETCH).T
    level = np.zeros((ROWS, COLUMNS))
    for _ in range(120):
        angle, period = waves.uniform(0.0, 2.0 * np.pi), waves.uniform(5.0, 20.0)
        turn = 2.0 * np.pi / period * np.array([np.cos(angle), np.sin(angle)])
        level += np.cos(place @ turn + waves.uniform(0.0, 2.0 * np.pi))
    inside = (place[..., 1] >= SPECIMEN.start) & (place[..., 1] < SPECIMEN.stop)
    clean = 2000.0 + np.where(inside, 80.0 * level, 0.0)
    noisy = clean + np.random.default_rng((seed, at_rest)).normal(0.0, NOISE, clean.shape)
    return np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)


def recorded(at_rest: bool, seed: int) -> Measurement:
    frame = image(at_rest, seed)
    return Measurement(AT, FringeSequence(), 4095, 0.0, NOISE, frame, ArrayStack(frame[None]))


def looked_at(
    seed: int, rest: DatasetOutput | None = None, *, size: float | None = SIZE_MM, same: bool = False
) -> DatasetOutput:
    """Return a look at the state at rest, or beside that at the moved one."""
    subject = Subject("test", "S00" if rest is None else "S01", "C1")
    frames = recorded(rest is None or same, seed + 100 * (rest is not None))
    datasets = {f"measurement {subject}": InMemory(subject, {"measurement": frames})}
    if rest is not None:
        before = replace(subject, state="S00")
        datasets["reference"] = InMemory(before, rest.records)
        datasets["reference_measurement"] = InMemory(before, {"measurement": recorded(True, seed)})
    plane = PlaneParameters(mm_per_px=size)
    compared = Compared("S00", (*GAUGES, OFF), AT_ORIGIN, StereoParameters(), plane)
    inputs = Inputs(subject, compared, datasets)
    (output,) = KIND.run(inputs, QuickLookParameters(), lambda fraction, message="": None)
    assert isinstance(output, DatasetOutput)
    KIND.checked(output)
    return output


def ends(gauge: str) -> Floats:
    """Return middle and ends of a gauge (3, 2), in px of the image at rest."""
    x, y, length, angle = GAUGES[gauge]
    half = 0.5 * length * np.array([np.cos(np.deg2rad(angle)), -np.sin(np.deg2rad(angle))])
    return np.array([x, y]) + np.array([0.0 * half, -half, half])


def test_gauges_read_what_is_true_within_what_they_state() -> None:
    """Of six pairs of images, three gauges and three numbers each the rms scatters by 0.1."""
    scores = []
    for seed in range(6):
        look = looked_at(seed, looked_at(seed)).records["look"]
        assert isinstance(look, QuickLook)
        assert look.doubts == ()
        assert list(look.reason) == [Reason.VALID] * len(GAUGES) + [Reason.TOO_FEW_NEIGHBOURS]
        for k, gauge in enumerate(GAUGES):
            before = ends(gauge)
            after = moved(before)
            way = SIZE_MM * (after[0] - before[0]) * (1.0, -1.0)
            long, short = (np.linalg.norm(one[2] - one[1]) for one in (after, before))
            scores += list((look.displacement[k, :2] - way) / look.sigma[k, :2])
            scores.append((look.extension[k] - SIZE_MM * (long - short)) / look.extension_sigma[k])
            assert look.displacement[k, 2] == 0.0
            assert look.place[k] == pytest.approx([SIZE_MM * before[0, 0], -SIZE_MM * before[0, 1], 0.0])
    rms = float(np.sqrt(np.mean(np.square(scores))))
    assert 0.7 < rms < 1.35, rms
    assert np.max(np.abs(scores)) < 4.5


def test_the_specimen_is_what_has_texture() -> None:
    output = looked_at(0)
    reason = output.records["surface"].reason
    # 160 of 240 rows have texture, but for the few px by which its extent is uncertain.
    assert (reason == Reason.VALID).mean() == pytest.approx(160 / 240, abs=0.06)
    assert (reason[0] == Reason.NO_TEXTURE).all()
    assert output.statistics["gauges_read"] == 0.0


def test_a_camera_whose_pixels_have_no_size_is_refused() -> None:
    with pytest.raises(
        InvalidInput, match=r"the image of C1 has no scale.*mm_per_px under \[processing.plane\]"
    ):
        looked_at(0, size=None)
