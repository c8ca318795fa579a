"""Fourier domain ranging: speed, precision against theory, close returns, plate and mirror, a large tuple."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from math import pi

import numpy as np

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run, cpu_seconds
from sms_jobs.bench.fringes import plate_mirror
from sms_jobs.bench.fringes.returns import (
    Signals,
    found_near,
    pairs,
    rms,
    simulate,
    single_bound,
    stronger_bound,
    wrapped,
)
from sms_jobs.bench.large import tuples
from sms_jobs.bench.peers import in_turn, timed

FRINGES = 64
_SIGNAL = "s = 64, densities 0 .. 63, 254 uint16 frames in memory, B / sigma = 50"
SIGNAL_TO_NOISE = 50.0
RATIO = 0.5
_HINGE_MM = 50.0  # the thesis's region of interrogation keeps off the hinge as well
_ROOM_GB = 12.0  # of the large tuple: its file, and what sealing needs for a while


def _scaled(run: Run, count: int) -> int:
    return count // 8 if run.quick else count


def one_return(pixels: int, fringes: int = FRINGES, signal_to_noise: float = SIGNAL_TO_NOISE) -> Signals:
    """Return frames of one return anywhere in the projector's image."""
    random = np.random.default_rng(11)
    return simulate(random.uniform(-pi, pi, (1, pixels)), (1.0,), fringes, signal_to_noise, random)


def two_returns(pixels: int, bins: tuple[float, float], ratio: float = RATIO) -> Signals:
    """Return frames of two returns that are `bins` of 2 pi / s apart, uniformly."""
    random = np.random.default_rng(12)
    omega = pairs(pixels, bins, FRINGES, random)
    return simulate(omega, (1.0, ratio), FRINGES, SIGNAL_TO_NOISE, random)


def warm_up() -> None:
    """Compile what the rates use."""
    one_return(512).ranged()
    two_returns(512, (0.5, 20.0)).ranged()
    one_return(2048).ranged(2)  # of so many, a few look like two at first and are fitted one by one


def _rates(run: Run) -> Iterator[Found]:
    pixels = _scaled(run, 1 << 17)
    run.say("fdr: speed of one and of two returns")
    single, double = one_return(pixels), two_returns(pixels, (0.5, 20.0))
    rate = pixels / 1e6 / cpu_seconds(single.ranged)
    yield Figure("one_return_mpx_per_cpu_s", rate, "Mpx / CPU-s", 4.0)
    rate = pixels / 1e6 / cpu_seconds(double.ranged)
    yield Figure("two_returns_mpx_per_cpu_s", rate, "Mpx / CPU-s", 2.5)
    (ratio,) = in_turn(timed(double.ranged), [timed(single.ranged)])
    yield ratio.figure("two_returns_over_one_return", 0.6)
    yield Condition(
        "rates",
        f"{_SIGNAL}; {pixels} px, one orientation, one thread; two returns of amplitude ratio {RATIO}, 0.5 "
        f"to 20 bins apart in every pixel, joint fit; both in turn for their ratio, {ratio.told()}",
    )


def _precision(run: Run) -> Iterator[Found]:
    pixels = _scaled(run, 1 << 16)
    run.say("fdr: precision and resolution against theory")
    single = one_return(pixels)
    error = wrapped(single.ranged().omega.reshape(1, -1) - single.omega)
    least = single_bound(FRINGES, SIGNAL_TO_NOISE)
    ratio = rms(error) / least
    yield Figure("one_return_rms_over_bound", ratio, "1", 1.03, "at most")
    yield Figure("one_return_bias_over_bound", abs(float(error.mean())) / least, "1", 0.1, "at most")
    far, far_rms = _resolved(two_returns(pixels, (0.5, 1.0)))
    near, _ = _resolved(two_returns(pixels, (0.3, 0.5)))
    _, apart_rms = _resolved(two_returns(pixels, (2.0, 2.0)))
    yield Figure("two_returns_success_0p5_to_1_bin", far, "1", 0.999)
    yield Figure("two_returns_success_0p3_to_0p5_bin", near, "1", 0.99)
    yield Figure("two_returns_rms_over_bound_0p5_to_1_bin", far_rms, "1", 1.2, "at most")
    yield Figure("two_returns_rms_over_bound_2_bins", apart_rms, "1", 1.2, "at most")
    yield Condition(
        "precision",
        f"{_SIGNAL}; {pixels} px a figure, omega anywhere in -pi .. pi, known-origin method; two returns of "
        f"amplitude ratio {RATIO} with joint fit; success: both found within a quarter bin, each by a return "
        "of its own; rms of the stronger where both are found, over the two-return known-origin bound of "
        "each pixel",
    )


def _resolved(signals: Signals) -> tuple[float, float]:
    """Return the part of pixels with both returns found, and the rms of the stronger over its bound there."""
    error, good = found_near(signals, signals.ranged())
    least = stronger_bound(signals.apart_bins, signals.fringes, SIGNAL_TO_NOISE)
    return float(good.mean()), rms((error[0] / least)[good])


def _plate(run: Run) -> Iterator[Found]:
    run.say("fdr: the plate and mirror")
    plate = plate_mirror.record("small", FRINGES, run.threads)
    cloud = plate.points({"method": "fdr", "returns": 2}, run.threads)
    off, sigma = plate.off_plane(cloud), plate.off_plane_sigma(cloud)
    inner = plate.twice & (plate.hinge_mm > _HINGE_MM)
    once, _ = plate_mirror.rms_off(off, plate.once)
    twice, part = plate_mirror.rms_off(off, inner)
    everywhere, whole = plate_mirror.rms_off(off, plate.twice)
    doubted = plate.off_plane(plate_mirror.unwrapped(plate, run.threads, plate_mirror.UNMASKED))
    unwrapped, _ = plate_mirror.rms_off(doubted, inner)
    noise = plate_mirror.rms_off(sigma, inner)[0] / plate_mirror.rms_off(sigma, plate.once)[0]
    nearest = float(np.nanmin(plate.hinge_mm[plate.twice]))
    yield Figure("plate_mirror_rms_ratio", twice / once, "1", 1.1, "at most")
    yield Figure("plate_mirror_unwrapping_over_fdr", unwrapped / twice, "1", 5.0)
    yield Figure("plate_mirror_rms_ratio_with_hinge", everywhere / once, "1", 1.1, "at most")
    yield Condition(
        "plate_mirror",
        f"thesis section 7.3.1 on the virtual rig, camera of 512 px, s = {FRINGES}, two returns, default "
        f"parameters; rms off the plane through what is lit once: {once:.4f} mm there, {twice:.4f} mm over "
        f"{part:.2%} of what is lit twice and more than {_HINGE_MM:.0f} mm off the hinge, where the noise of "
        f"the second return's light alone makes the ratio {noise:.3f}; {everywhere:.4f} mm over "
        f"{whole:.2%} from {nearest:.0f} mm off the hinge on; temporal unwrapping of 32, 31, 30, 28, 24, "
        f"16 fringes, without the masks that would leave nothing, {unwrapped:.3f} mm beyond "
        f"{_HINGE_MM:.0f} mm",
    )


def _tuple(run: Run) -> Iterator[Found]:
    names = ("tuple_4mpx_s64_wall_s", "tuple_4mpx_s64_peak_rss_mb")
    free = shutil.disk_usage(run.folder).free / 1e9
    if run.quick or free < _ROOM_GB:
        why = "--quick" if run.quick else f"for want of {_ROOM_GB:.0f} GB on the disk of {run.folder}"
        yield Condition("tuple_4mpx_s64", f"left out, {why}")
        yield Figure(names[0], None, "s", 15.0, "at most")
        yield Figure(names[1], None, "MB", 1500.0, "at most")
        return
    run.say("fdr: making a tuple of 4 megapixels and 508 frames")
    tuples.seal(run.folder, "tiny", 64, run.threads)
    size = tuples.seal(run.folder, "large", tuples.PIXELS, run.threads)
    run.say("fdr: reconstructing it")
    taken = tuples.measure(run.folder, run.threads)
    yield Condition(
        "tuple_4mpx_s64",
        f"508 frames of 2048 x 2048 px, 12 bits with shot and read noise, {size:.2f} GB sealed, just written "
        "and so in the system's cache as far as memory allows; method fdr, two returns, the lower half lit "
        "twice; from the archive into the archive with verification, kernels compiled, "
        f"{run.threads} threads, {taken.cpu_s:.1f} CPU-s, {taken.valid_fraction:.1%} of all pixels valid",
    )
    yield Figure(names[0], taken.wall_s, "s", 15.0, "at most")
    yield Figure(names[1], taken.peak_rss_mb, "MB", 1500.0, "at most")


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    for part in (_rates, _precision, _plate, _tuple):
        yield from part(run)


GROUP = Group("fdr", "speed and precision of Fourier domain ranging", warm_up, measure)
