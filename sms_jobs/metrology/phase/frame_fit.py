"""How well the frames of a recording are explained by the patterns that they are said to show.

A pixel that sees one surface has the grey levels A + B_t cos(omega t + 2 pi k / q) in all frames of an
orientation: one mean, one phase gradient, one modulation for each density. That leaves q n - n - 2 degrees of
freedom, of which the phase error uses n - 1. What is left over, frame by frame and over many pixels, says of
which frame something is told that is not so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Mask, Singles
from sms_jobs.metrology.images.masks import phase_error_factor
from sms_jobs.metrology.phase.grey_levels import GreyLevels
from sms_jobs.metrology.phase.phase_stepping import phase_sigma, stepping_weights
from sms_jobs.metrology.phase.temporal_unwrapping import CoarseGradient, unwrap

_CAP = 9.0
"""Of a squared misfit in units of its variance: what is off by more than three deviations is just wrong."""
_LIT = 5.0  # standard deviations of noise by which the frames of a pixel scatter at least
_SATURATED = 2  # frames of a pixel at full scale, at most: one that is overexposed shall be found
_KEPT = 0.999
_MISFIT = 1.0  # of a frame: noise and what is accepted, together
_TO_OTHERS = 3.0  # times the median frame's misfit
_HARMONICS = 3
_LEAST_EXCESS, _SURE = 0.05, 4.0
_ROUNDED = 1.0 / 12.0  # variance of a grey level by being a whole number
_TINY = np.finfo(np.float32).tiny


@dataclass(frozen=True)
class SampledFrames:
    """Frames of one orientation at some pixels, and what they are said to show.

    Attributes
    ----------
    levels
        (densities * steps, pixels), grey levels of the camera's own type, densities slower than steps.
    densities, steps
        Without the density 0.
    grey_levels
        What they mean.
    accepted_rad
        Phase error of the fringes themselves that is accepted.
    offsets
        What the patterns of each density add to the phase, in rad; none if empty.
    ranged
        Whether pixels may see several surfaces, so that their phases need not belong to one gradient.
    coarse
        What a code beside the fringes tells of the gradient at each pixel, (1, pixels); None for no code.
    """

    levels: NDArray[Any]
    densities: tuple[float, ...]
    steps: int
    grey_levels: GreyLevels
    accepted_rad: float
    offsets: tuple[float, ...] = ()
    ranged: bool = False
    coarse: CoarseGradient | None = None

    def thinned(self, every: int) -> SampledFrames:
        """Return the same of every so many pixels."""
        levels = np.ascontiguousarray(self.levels[:, ::every])
        if self.coarse is None:
            return replace(self, levels=levels)
        coarse = CoarseGradient(self.coarse.omega[:, ::every], self.coarse.half_width)
        return replace(self, levels=levels, coarse=coarse)

    @property
    def least_share(self) -> float:
        """Part of the lit pixels whose phases agree, below which something must be wrong.

        Half of them; a tenth where pixels may see several surfaces; nine tenths of two densities, which agree
        by chance in many pixels.
        """
        return 0.1 if self.ranged else 0.9 if len(self.densities) == 2 else 0.5

    @property
    def accepted_level(self) -> float:
        """Departure of a single frame, in units of the modulation, that moves a phase by `accepted_rad`.

        A departure e moves it by (2/q) e sin(phase), of which this is the largest.
        """
        return self.accepted_rad * self.steps / 2.0


@dataclass(frozen=True)
class FringeModel:
    """The fringes of one phase gradient, as they were fitted to frames.

    Attributes
    ----------
    densities
        (densities, 1).
    steps
        Of each.
    expected
        (densities, pixels): phasor of the fringe at step 0, of length 1.
    amplitude
        (densities, pixels): of the fringe, in grey levels, not negative.
    modulation
        (pixels,): that of all densities, root mean square.
    """

    densities: Singles
    steps: int
    expected: NDArray[np.complex64]
    amplitude: Singles
    modulation: Singles

    def unexplained(self, change: Singles) -> tuple[Singles, Singles]:
        """Return what of a small change of frames fits no mean, gradient, modulations, harmonics.

        Parameters
        ----------
        change
            (densities, steps, pixels), grey levels.

        Returns
        -------
        What is left of it, and the change (pixels,) of the gradient, in rad per fringe.
        """
        turned = _phasors(change) * self.expected.conj()
        by_gradient = self.amplitude * self.densities
        squares = np.maximum(np.sum(by_gradient * by_gradient, axis=0), _TINY)
        gradient = np.sum(by_gradient * turned.imag, axis=0) / squares
        fringe = self.expected * (turned.real + 1j * by_gradient * gradient)
        return self.without_fringes(change - change.mean(axis=(0, 1)), fringe), gradient

    def without_fringes(self, departure: Singles, fringe: NDArray[np.complex64]) -> Singles:
        """Take fringes, and the harmonics of the model's, from frames less their mean, in place.

        The frames are (densities, steps, pixels); `fringe` (densities, pixels) is the fringe at step 0.
        """
        steps, expected = self.steps, self.expected
        turns = np.exp(2j * pi * np.arange(steps) / steps).astype(np.complex64)
        wave = fringe
        for n in range(1, _HARMONICS + 1):
            turn = turns**n
            if n > 1:
                wave = self.modulation * expected**n
                seen = np.einsum("k,tkp->tp", turn.conj(), departure)
                # Where a step turns the harmonic by half a turn or not at all, its cosine alone is seen.
                power = np.square(wave.real) if 2 * n % steps == 0 else 0.5 * np.square(np.abs(wave))
                total = np.maximum(steps * power.sum(axis=1), _TINY)
                wave = wave * (np.sum((seen * wave.conj()).real, axis=1) / total)[:, None]
            for k in range(steps):
                departure[:, k] -= turn[k].real * wave.real - turn[k].imag * wave.imag
        return departure


@dataclass(frozen=True)
class FrameFit:
    """What frames leave unexplained.

    Attributes
    ----------
    model
        The fringes that they show.
    departure
        (densities, steps, pixels): frames less their mean, these fringes and their harmonics, in grey levels.
    noise
        (pixels,): standard deviation of a grey level, that of a whole number at least.
    consistent
        (pixels,): where the phases of all densities belong to one phase gradient.
    misfit
        (densities, steps): mean squared departure of a frame over the consistent pixels (all of them where
        these are few), in units of noise and of what is accepted; single pixels count for at most 9.
    total
        The same over all frames and pixels: what explanations are compared by.
    residual
        (densities, pixels): phase less the one that the gradient predicts, in rad.
    weight
        (densities, pixels): inverse variance of `residual` in rad^-2, with what is accepted.
    least_share
        That of the sampled frames.
    shift, shift_sigma
        (densities,): mean of `residual` over the consistent pixels, and its standard deviation.
    excess
        Variance that phases have besides noise and harmonics, in units of that of noise, over the consistent
        pixels; 0 where it is no more than a twentieth, by which a noise model may be off, or than four of its
        standard deviations.
    """

    model: FringeModel
    departure: Singles
    noise: Singles
    consistent: Mask
    misfit: Singles
    total: float
    residual: Singles
    weight: Singles
    least_share: float
    shift: Singles
    shift_sigma: Singles
    excess: float

    @property
    def share(self) -> float:
        """Part of the pixels that are consistent; 0 where there are none."""
        return float(self.consistent.mean()) if self.consistent.size else 0.0

    @property
    def few_agree(self) -> bool:
        """Whether the phases of so few of the pixels agree that something must be wrong."""
        return self.share < self.least_share

    @property
    def guilty(self) -> Mask:
        """Which frames (densities, steps) depart by more than noise, what is accepted, and the others."""
        return np.asarray(self.misfit > max(_MISFIT, _TO_OTHERS * float(np.median(self.misfit))))

    @property
    def agrees(self) -> bool:
        """Whether the frames are consistent with what is stated of them."""
        return not (self.few_agree or self.guilty.any())


def lit_pixels(levels: NDArray[Any], grey_levels: GreyLevels) -> Mask:
    """Return the pixels, (pixels,), whose frames (frames, pixels) differ by more than noise and are in range.

    It needs no word about what the frames show.
    """
    mean = levels.mean(axis=0, dtype=np.float32)
    scatter = levels.std(axis=0, dtype=np.float32)
    saturated = np.count_nonzero(levels >= grey_levels.full_scale, axis=0)
    return np.asarray((scatter > _LIT * np.sqrt(grey_levels.variance(mean))) & (saturated <= _SATURATED))


def fit_frames(sampled: SampledFrames) -> FrameFit:
    """Fit mean, phase gradient and modulations to every pixel, and say what is left.

    Raises `InvalidInput` for densities that leave the gradient ambiguous.

    Notes
    -----
    The second and the third harmonic of each density, one amplitude for all pixels, are taken out: a
    projector that is not linear is no fault of a frame. They do not shift the phases in the mean over a
    fringe.
    """
    densities, steps, grey = sampled.densities, sampled.steps, sampled.grey_levels
    found = unwrap(
        sampled.levels[:, None, :],
        densities,
        steps,
        full_scale=grey.full_scale,
        gain=grey.gain,
        read_noise=grey.read_noise,
        offsets=sampled.offsets,
        coarse=sampled.coarse,
    )
    omega = np.nan_to_num(found.omega[0])
    stack = sampled.levels.reshape(len(densities), steps, -1).astype(np.float32)
    mean, modulation = found.mean_intensity[0], found.modulation[0]
    noise = np.sqrt(grey.variance(mean))
    z = _phasors(stack)
    phase = np.multiply.outer(densities, omega) + np.reshape(sampled.offsets or 0.0, (-1, 1))
    expected = np.exp(1j * phase).astype(np.complex64)
    turned = z * expected.conj()
    amplitude = np.maximum(turned.real, 0.0)
    model = FringeModel(np.array(densities, np.float32)[:, None], steps, expected, amplitude, modulation)
    departure = model.without_fringes(stack - mean, expected * amplitude)
    misfit = np.square(departure)
    misfit /= np.square(noise) + np.square(sampled.accepted_level * modulation)
    np.minimum(misfit, _CAP, out=misfit)
    residual = np.angle(turned).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        limit = phase_error_factor(len(densities), _KEPT) * phase_sigma(noise, modulation, steps)
        limit = np.hypot(limit, sampled.accepted_rad)
        weight = 1.0 / (np.square(phase_sigma(noise, np.abs(z), steps)) + sampled.accepted_rad**2)
    error = found.phase_error[0]
    consistent = ~found.ambiguous[0] & (np.isnan(error) | (error < limit)) & np.isfinite(found.omega[0])
    judged = consistent if consistent.any() else np.ones_like(consistent)
    least_noise = np.sqrt(np.maximum(np.square(noise), np.float32(_ROUNDED)))
    count = np.sqrt(np.count_nonzero(judged))
    return FrameFit(
        model,
        departure,
        least_noise,
        consistent,
        misfit[:, :, judged].mean(axis=2),
        float(misfit.mean()),
        residual,
        weight.astype(np.float32),
        sampled.least_share,
        residual[:, judged].mean(axis=1),
        residual[:, judged].std(axis=1) / np.float32(count),
        _excess(model, departure[..., judged], least_noise[judged], judged),
    )


def _excess(model: FringeModel, departure: Singles, noise: Singles, judged: Mask) -> float:
    """Return the excess of `FrameFit`, of what the judged pixels leave.

    By what densities leave of their phases, n - 1 degrees of freedom. A single one leaves none: by all that
    its frames leave, steps - 3, as lights that differ from frame to frame move phases, too.
    """
    densities, steps = departure.shape[:2]
    if densities > 1:
        phases = (_phasors(departure) * model.expected[:, judged].conj()).imag
        left, freedom = np.sum(np.square(phases), axis=0) * (0.5 * steps), densities - 1
    else:
        left, freedom = np.sum(np.square(departure), axis=(0, 1)), steps - 3
    if not freedom or not noise.size:
        return 0.0
    times = np.asarray(left / (freedom * np.square(noise)), np.float64)
    excess, sigma = float(times.mean()) - 1.0, float(times.std() / np.sqrt(times.size))
    return excess if excess > max(_LEAST_EXCESS, _SURE * sigma) else 0.0


def _phasors(stack: Singles) -> NDArray[np.complex64]:
    """Return the fringes at step 0 of frames (densities, steps, pixels), (densities, pixels)."""
    cosine, sine = stepping_weights(stack.shape[1]).astype(np.float32)
    return np.asarray(np.einsum("k,tkp->tp", cosine, stack) + 1j * np.einsum("k,tkp->tp", sine, stack))


def share_by_chance(sampled: SampledFrames) -> float:
    """Return the part of the pixels whose phases would agree if those of the densities had nothing in common.

    The densities are taken from different pixels, drawn with a fixed seed. Three standard deviations of a
    count are added.
    """
    random = np.random.default_rng(0)
    stack = sampled.levels.reshape(len(sampled.densities), sampled.steps, -1)
    mixed = [levels[:, random.permutation(stack.shape[2])] for levels in stack]
    count = stack.shape[2] * fit_frames(replace(sampled, levels=np.concatenate(mixed))).share
    return float((count + 3.0 * np.sqrt(max(count, 1.0))) / stack.shape[2])
