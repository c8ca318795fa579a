"""A Gray code without fringes: every point in its stripes as is stated, and wrong words refused by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.measured_plate import Seen, in_sigmas, reconstructed, simulated

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.records.gray_code import GrayCode, Threshold
from sms_jobs.records.measurement import ArrayStack, FringeSequence
from sms_jobs.records.reasons import Reason

BOTH = (0.0, pi / 2)


def coded(code: GrayCode, **light: dict[str, float]) -> Seen:
    return simulated(FringeSequence((), orientations_rad=BOTH, gray=code), **light)


@pytest.mark.parametrize("threshold", ["inverse", "white-black"])
@pytest.mark.parametrize(
    ("stripes", "camera", "projector", "low", "high"),
    [
        ((32.0,), {}, {}, 0.8, 1.1),
        ((128.0,), {}, {}, 0.8, 1.1),
        ((256.0, 192.0), {}, {}, 0.8, 1.1),  # of a pixel of the projector each
        ((200.0, 150.0), {"ambient": 0.3}, {"gamma": 2.2}, 0.8, 1.1),
        # Doubtful bits leave more stripes than one, which is stated as if all were as likely.
        ((128.0,), {"read_noise": 300.0}, {}, 0.6, 1.1),
        ((128.0,), {}, {"defocus_px": 4.0}, 0.6, 1.1),
        # The texture moves what a camera out of focus sees, and nothing tells how far.
        ((128.0,), {"blur_px": 1.5}, {}, 0.85, 1.2),
    ],
)
def test_points_lie_within_their_stripes_as_is_stated(
    threshold: Threshold,
    stripes: tuple[float, ...],
    camera: dict[str, float],
    projector: dict[str, float],
    low: float,
    high: float,
) -> None:
    code = GrayCode(int(np.ceil(np.log2(max(stripes)))), stripes, threshold)
    calibration, measurement, shape = coded(code, camera=camera, projector=projector)
    surface = reconstructed(calibration, measurement)
    valid = surface.reason == Reason.VALID
    assert valid[shape.lit].mean() > 0.9
    z = in_sigmas(surface, shape)
    assert low < np.std(z) < high
    # No error is larger than half of the stripes, 1.73 deviations, but by what light beside a pixel adds.
    assert np.mean(np.abs(z) > 3.0) < 0.02
    assert np.abs(z).max() < 7.0


def test_a_projector_out_of_focus_leaves_wider_stripes() -> None:
    each = [coded(GrayCode(7, (128.0,)), projector={"defocus_px": blur}) for blur in (0.0, 4.0)]
    sharp, soft = (reconstructed(one[0], one[1]) for one in each)
    sigma = [np.sqrt(np.median(s.covariance[5][s.reason == Reason.VALID])) for s in (sharp, soft)]
    assert 3.0 < sigma[1] / sigma[0] < 5.0  # two bits of seven are lost


def exchanged(*pairs: tuple[int, int]) -> Callable[[NDArray[Any]], NDArray[Any]]:
    def change(frames: NDArray[Any]) -> NDArray[Any]:
        found = frames.copy()
        for i, j in pairs:
            found[[i, j]] = frames[[j, i]]
        return found

    return change


def blocks(frames: NDArray[Any]) -> NDArray[Any]:
    """All patterns of a direction before their inverses."""
    return np.concatenate([frames[k : k + 14][i::2] for k in (0, 14) for i in (0, 1)])


def fine_first(frames: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate(
        [frames[k : k + 14].reshape(7, 2, 128, 128)[::-1].reshape(14, 128, 128) for k in (0, 14)]
    )


def binary(frames: NDArray[Any]) -> NDArray[Any]:
    """A bit of the number itself is the exclusive or of those of the Gray code up to it."""
    pairs = frames.reshape(2, 7, 2, 128, 128)
    bright = np.logical_xor.accumulate(pairs[:, :, 0] > pairs[:, :, 1], axis=1)
    high, low = pairs.max(axis=2), pairs.min(axis=2)
    shown = np.stack([np.where(bright, high, low), np.where(bright, low, high)], axis=2)
    return shown.reshape(frames.shape)


def exposed(frame: int, times: float) -> Callable[[NDArray[Any]], NDArray[Any]]:
    def change(frames: NDArray[Any]) -> NDArray[Any]:
        found = frames.copy()
        found[frame] = np.minimum(times * frames[frame], 4095.0)
        return found

    return change


def twice_white(frames: NDArray[Any]) -> NDArray[Any]:
    return np.concatenate([frames[:-1], frames[-2:-1]])


@pytest.mark.parametrize(
    ("threshold", "change", "told"),
    [
        ("inverse", exchanged((4, 8), (5, 9)), "along 0 deg: bits 2 and 4 have changed places"),
        ("inverse", exchanged((20, 21)), "along 90 deg: bit 3 is inverted"),
        ("inverse", exchanged((4, 9)), "along 0 deg: patterns and inverses of bits 2, 4 do not add up"),
        ("inverse", blocks, "see if frames are gray+inverse or gray inverse"),
        ("inverse", fine_first, "shown in the other order"),
        ("inverse", binary, "the patterns are a plain binary code, not a Gray code"),
        ("white-black", exchanged((1, 3)), "along 0 deg: bits 1 and 3 have changed places"),
        ("white-black", exchanged((14, 15)), "the black frame is brighter than the white one"),
        ("white-black", exchanged((9, 15)), "along 0 deg: bit"),
        ("white-black", exposed(14, 2.0), "the middle of white and black lies 0.49 of what"),
        ("white-black", exposed(14, 0.7), "is brighter than white or darker than black"),
        ("white-black", twice_white, "the middle of white and black lies 0.49 of what"),
    ],
)
def test_frames_in_another_order_are_refused_by_name(
    threshold: Threshold, change: Callable[[NDArray[Any]], NDArray[Any]], told: str
) -> None:
    calibration, measurement, _ = coded(GrayCode(7, (128.0,), threshold))
    frames = change(measurement.frames.rows(0, 128))
    with pytest.raises(MeasurementFailed, match="are not what they are said to be") as said:
        reconstructed(calibration, replace(measurement, frames=ArrayStack(frames)))
    assert told in str(said.value)


def test_light_that_a_specimen_scatters_all_over_is_no_mishap() -> None:
    """Under a skin or in a hollow white gets more of it than a pattern, of which half is dark."""
    calibration, measurement, _ = coded(GrayCode(7, (128.0,), "white-black"))
    frames = measurement.frames.rows(0, 128)
    half = 0.3 * np.clip(frames[14:15].astype(float) - frames[15:16], 0.0, None)
    lit = np.concatenate([frames[:14] + half, frames[14:15] + 2.0 * half, frames[15:]])
    dimmed = (0.6 * lit).astype(frames.dtype)  # or white would saturate
    found = reconstructed(calibration, replace(measurement, frames=ArrayStack(dimmed)))
    as_usual = reconstructed(calibration, measurement)
    assert np.mean(found.reason == Reason.VALID) > 0.9 * np.mean(as_usual.reason == Reason.VALID)


def test_exchanged_directions_are_refused() -> None:
    calibration, measurement, _ = coded(GrayCode(7, (128.0,)))
    frames = measurement.frames.rows(0, 128)
    other = replace(measurement, frames=ArrayStack(np.concatenate([frames[14:], frames[:14]])))
    with pytest.raises(MeasurementFailed, match="deg"):
        reconstructed(calibration, other)


def test_what_needs_fringes_is_refused() -> None:
    calibration, measurement, _ = coded(GrayCode(5, (32.0,)))
    for parameters in ({"method": "fdr"}, {"response": "measured"}):
        with pytest.raises(InvalidInput, match="have a Gray code, which only method=temporal-unwrapping"):
            reconstructed(calibration, measurement, **parameters)
    with pytest.raises(InvalidInput, match="needs the inverse of each pattern, or white and black"):
        FringeSequence((), gray=GrayCode(5, (32.0,), "fringes"))
    with pytest.raises(InvalidInput, match="one for each of the 2 orientations, not 3"):
        FringeSequence((), gray=GrayCode(5, (32.0, 30.0, 20.0)))
