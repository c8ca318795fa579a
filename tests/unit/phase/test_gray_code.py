"""Gray code: stripes are read back, and unwrap fringes that alone are ambiguous."""

from __future__ import annotations

from math import isnan, nan, pi
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.foreign_frames import gray_pattern

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.gray_code import UNREAD, gradient_of_stripes, read_stripes
from sms_jobs.metrology.phase.temporal_unwrapping import unwrap
from sms_jobs.metrology.phase.unwrapping_plan import unwrapping_plan
from sms_jobs.records.gray_code import GrayCode

COLUMNS = 1920
DOUBT = np.float32(4.0)
MEAN, MODULATION = 100.0, 60.0


def seen(columns: NDArray[np.float64], bits: int, stripes: float) -> NDArray[np.float64]:
    """Return the patterns of a code at projector pixels, (bits, 1, pixels), in grey levels."""
    stripe = np.floor((columns + 0.5) / COLUMNS * stripes).astype(int)
    bright = np.stack([gray_pattern(stripe, b, bits) for b in range(bits)])
    return np.where(bright, MEAN + MODULATION, MEAN - MODULATION)[:, None, :]


def above(frames: NDArray[np.float64], threshold: Any) -> NDArray[np.float32]:
    return np.asarray(frames - threshold, np.float32)


def fringes(
    columns: NDArray[np.float64], densities: tuple[int, ...], steps: int, offsets: tuple[float, ...]
) -> NDArray[np.float64]:
    omega = 2.0 * pi * (columns + 0.5 - COLUMNS / 2) / COLUMNS
    return np.stack(
        [
            MEAN + MODULATION * np.cos(omega * t + offset + 2.0 * pi * k / steps)
            for t, offset in zip(densities, offsets, strict=True)
            for k in range(steps)
        ]
    )[:, None, :]


@given(bits=st.integers(1, 16), stripe=st.integers(0, 2**16 - 1))
def test_a_stripe_is_read_as_itself_and_differs_from_the_next_in_one_pattern(bits: int, stripe: int) -> None:
    stripe %= 2**bits
    here, there = (np.array([gray_pattern(s, b, bits) for b in range(bits)]) for s in (stripe, stripe + 1))
    frames = np.where(here, 200.0, 20.0)[:, None, None]
    found = read_stripes(above(frames, 110.0), DOUBT, 2.0**bits)
    assert (found.stripe[0, 0], found.middle[0, 0], found.width[0, 0]) == (stripe, stripe + 0.5, 1.0)
    if stripe + 1 < 2**bits:
        assert (here != there).sum() == 1


@pytest.mark.parametrize(
    ("levels", "middle", "width"),
    [
        ((1, 0, 1), 6.5, 1.0),  # every bit is sure
        ((1, 0.01, 1), 6.0, 1.0),  # the border of 5 and 6: half a stripe on either side
        ((0.01, 1, -1), 4.0, 1.0),  # of 3 and 4
        ((1, 1, 0.01), 5.0, 2.0),  # the finest bit may be too fine to be seen: 4 or 5
        ((1, -0.01, 0.01), 6.0, 4.0),  # and the next: 4 .. 7
        ((0.01, 1, 0.01), 4.0, 4.0),  # the border of 3 and 4, where the finest bit cannot be seen: 2 .. 5
        ((1, 0.01, -1), nan, 0.0),  # 4 or 7, which is no border
        ((0.01, 0.01, -1), nan, 0.0),
    ],
)
def test_doubtful_bits_leave_the_stripes_that_agree(
    levels: tuple[float, ...], middle: float, width: float
) -> None:
    signs = [2.0 * (level > 0) - 1.0 if level in (0, 1, -1) else level for level in levels]
    # The finest pattern is seen clearly nowhere near by.
    clear = np.array([True, True, False])[:, None, None]
    found = read_stripes(np.array(signs, np.float32)[:, None, None], np.float32(0.1), 8.0, clear)
    assert (found.stripe[0, 0] == UNREAD) == isnan(middle)
    if not isnan(middle):
        assert (found.middle[0, 0], found.width[0, 0]) == (middle, width)


@pytest.mark.parametrize(("bits", "stripes", "density"), [(6, 64.0, 32), (5, 32.0, 32), (7, 96.0, 40)])
def test_the_code_gives_the_fringe_order(
    bits: int, stripes: float, density: int, rng: np.random.Generator
) -> None:
    columns = np.sort(rng.uniform(0.0, COLUMNS - 1.0, 5000))
    code = seen(columns, bits, stripes) + rng.normal(0.0, 1.0, (bits, 1, columns.size))
    frames = np.rint(fringes(columns, (density,), 12, (0.0,)) + rng.normal(0.0, 1.0, (12, 1, columns.size)))
    found = read_stripes(above(code, frames.mean(axis=0)), DOUBT, stripes)
    stripe = found.nearly_sure
    gradient = unwrap(
        frames.astype(np.uint8),
        (density,),
        12,
        full_scale=255,
        gain=0.0,
        read_noise=1.0,
        coarse=gradient_of_stripes(stripe, stripes),
    )
    truth = 2.0 * pi * (columns + 0.5 - COLUMNS / 2) / COLUMNS
    # Noise of 1 and rounding (1/12) in 12 frames of modulation 60: 0.0071 rad a phase; 6 sigma.
    assert np.abs(gradient.omega[0] - truth)[~gradient.ambiguous[0]].max() < 6.0 * 0.0071 / density
    # Where a stripe is as wide as a fringe, a tenth of the fringe at its borders is given up.
    assert gradient.ambiguous.mean() < (0.15 if stripes == density else 0.001)


def test_how_far_off_a_stripe_may_be_read() -> None:
    columns = np.arange(30.0, 1800.0)
    frames = fringes(columns, (32,), 12, (0.0,))
    stripe = np.floor((columns + 0.5) / COLUMNS * 64).astype(np.int32)[None]
    wrong = gradient_of_stripes(stripe + 2, 64.0)  # by a whole fringe
    right = gradient_of_stripes(stripe, 64.0)
    settings = {"full_scale": 255, "gain": 0.0, "read_noise": 1.0}
    whole = unwrap(frames.astype(np.uint16), (32,), 12, coarse=right, **settings)
    assert not whole.ambiguous.any()
    # Off by a fringe it follows the code: fringes of one density alone cannot tell.
    off = unwrap(frames.astype(np.uint16), (32,), 12, coarse=wrong, **settings)
    assert np.abs(off.omega - whole.omega - 2.0 * pi / 32)[~off.ambiguous].max() < 1e-6
    # A border that is read a fifth of a stripe, 6 pixels, off its place costs nothing.
    beside = np.floor((columns + 6.5) / COLUMNS * 64).astype(np.int32)[None]
    near = unwrap(frames.astype(np.uint16), (32,), 12, coarse=gradient_of_stripes(beside, 64.0), **settings)
    assert not near.ambiguous.any()
    assert np.abs(near.omega - whole.omega).max() < 1e-6
    # Half a fringe off, corrections fill pi / 2 .. 3 pi / 2: those nearer to pi than pi / 4 are noticed.
    half = unwrap(
        frames.astype(np.uint16), (32,), 12, coarse=gradient_of_stripes(stripe + 1, 64.0), **settings
    )
    assert 0.4 < half.ambiguous.mean() < 0.6


@pytest.mark.parametrize("steps", [3, 4, 5])
def test_phases_that_begin_elsewhere_give_the_same_gradient(steps: int, rng: np.random.Generator) -> None:
    columns = np.arange(0.0, COLUMNS, 7.0)
    densities = (16, 5, 1)
    offsets = tuple(rng.uniform(-pi, pi, 3))
    settings = {"full_scale": 65_535, "gain": 0.0, "read_noise": 1.0}
    found = [
        unwrap(
            np.rint(200.0 * fringes(columns, densities, steps, o)).astype(np.uint16),
            densities,
            steps,
            offsets=o,
            **settings,
        ).omega
        for o in ((0.0, 0.0, 0.0), offsets)
    ]
    # Rounding to whole levels of a modulation of 12,000: 2.4e-5 rad a phase, over a root mean density of 9.7.
    assert np.abs(found[0] - found[1]).max() < 6.0 * 2.0 * 2.4e-5 / 9.7


def test_a_code_coarser_than_fringes_is_refused() -> None:
    frames = np.zeros((3, 1, 4), np.uint8)
    coarse = gradient_of_stripes(np.zeros((1, 4), np.int32), 16.0)
    with pytest.raises(InvalidInput, match="2 times as wide as a fringe"):
        unwrap(frames, (32,), 3, full_scale=255, gain=0.0, read_noise=1.0, coarse=coarse)
    with pytest.raises(InvalidInput, match="2 to 8 stripes"):
        GrayCode(3, (1.0,))
    with pytest.raises(InvalidInput, match="1 to 16 patterns"):
        GrayCode(17, (2.0,))


def test_with_a_code_the_lowest_density_begins() -> None:
    plan = unwrapping_plan((48, 32), True)
    assert [plan.densities[i] for i in plan.first[plan.below == -1]] == [32]
    with pytest.raises(InvalidInput, match="share the factor"):
        unwrapping_plan((48, 32))
