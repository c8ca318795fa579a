"""The tuple that the benchmark reconstructs, at a size for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sms_jobs.bench.large import tuples
from sms_jobs.bench.peak_memory import peak_rss_mb
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.reasons import Reason

SEQUENCE = FringeSequence(tuple(range(8)))


def made(threads: int = 1) -> tuples.SyntheticFrames:
    calibration = tuples.rig(48)
    return tuples.SyntheticFrames(tuples.scene(calibration, SEQUENCE), SEQUENCE, threads)


def test_frames_do_not_depend_on_threads_or_order() -> None:
    one, two = made(1), made(2)
    assert one.shape == (60, 48, 48)
    slab = one.rows(10, 20)
    for index in (59, 0, 17):
        np.testing.assert_array_equal(two.frame(index)[10:20], slab[index])


def test_frames_have_the_noise_that_the_measurement_states() -> None:
    frames = made().rows(0, 48).astype(float)
    # Steps 0 and 2 add up to twice the mean level: what their sums differ by between densities is noise.
    sums = np.array([frames[2 + 4 * i] + frames[4 + 4 * i] for i in range(7)])
    lit = sums.mean(axis=0) > 400.0
    level = frames[2:30].mean(axis=0)
    variance = sums.var(axis=0, ddof=1) / 2.0
    expected = tuples.READ_NOISE**2 + 1.0 / 12.0 + tuples.GAIN * level
    # Some 2000 pixels of 7 sums each give the mean ratio to 1.3 %.
    assert abs(np.mean((variance / expected)[lit]) - 1.0) < 0.06


def test_a_sealed_tuple_is_reconstructed_in_place(home: Path) -> None:
    size = tuples.seal(home, "tiny", 48, 1)
    assert 0.0 < size < 0.01
    output = tuples.reconstruct(home, "tiny", 1)
    cloud = output.records["surface"]
    assert isinstance(cloud, Surface)
    valid = cloud.reason == Reason.VALID
    assert valid.mean() > 0.5
    # The plate is in z = 0; half of it is lit twice, and its points scatter by some hundredths of a mm.
    assert np.median(np.abs(cloud.position[2, valid])) < 0.1
    assert len(list((home / "archive").rglob("reconstruct-*.h5"))) == 1


def test_peak_memory_is_known() -> None:
    assert 20.0 < peak_rss_mb() < 1e6
