"""Matching by the peak of the cross-correlation, found by Newton's method in the Fourier domain.

This is the thesis's own algorithm (section 4.3.2), with its sub-images cut to one region. It knows a shift
alone, and both sub-images end at their borders, so that speckle on the rim which one of them shows and the
other does not pulls the peak towards whole pixels. It is there to compare with.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from sms_jobs.metrology.arrays import Complexes, Floats, Ints, Mask
from sms_jobs.metrology.compilation import in_row_blocks
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    LEFT_IMAGE,
    NO_TEXTURE,
    NOT_CONVERGED,
    TOO_FEW_PIXELS,
    Matches,
    MatchSettings,
    PreparedImages,
    blank_matches,
    least_pixels,
)

_CUTS = 4  # times that the deformed sub-image is cut anew about the whole pixel nearest to the peak
_STEPS = 3  # of Newton's method along one axis before the other axis has its turn
_BLOCK = 64  # points that are transformed together


@dataclass(frozen=True)
class _Spectrum:
    """The product of two sub-images' transforms, n of them; frequencies in rad a pixel.

    `values` is (n, rows, columns), for the frequencies along x that are not negative; the others follow
    from them since images are real, and count by `along_x_weight`.
    """

    values: Complexes
    along_y: Floats
    along_x: Floats
    along_x_weight: Floats

    def reduced_along_y(self, v: Floats) -> Complexes:
        """Return the one-dimensional spectrum (n, columns) along x at the shifts v."""
        turned = np.exp(1j * v[:, None] * self.along_y)
        return np.asarray(np.einsum("npq,np->nq", self.values, turned) * self.along_x_weight)

    def reduced_along_x(self, u: Floats) -> Complexes:
        """Return the one-dimensional spectrum (n, rows) along y at the shifts u."""
        turned = np.exp(1j * u[:, None] * self.along_x) * self.along_x_weight
        return np.asarray(np.einsum("npq,nq->np", self.values, turned))


def cross_spectrum(first: Floats, second: Floats) -> tuple[_Spectrum, Floats]:
    """Return the product of transforms conj(F(I1')) F(I2') of padded sub-images, and C at whole shifts.

    Parameters
    ----------
    first, second
        (n, side, side): sub-images without their means, zero where another region is seen.

    Returns
    -------
    The spectrum, scaled so that its sum over all frequencies is C(0, 0); and C (n, m, m), whose element
    (v, u) is that of thesis Eq. (3.10) for the shift (u, v), negative ones counted from the end.

    Notes
    -----
    Thesis Eq. (3.11)-(3.13): padded to twice the side, no shift of less than the side wraps round.
    """
    m = fft.next_fast_len(2 * first.shape[-1], real=True)
    product = np.conj(fft.rfft2(first, (m, m))) * fft.rfft2(second, (m, m))
    whole: Floats = fft.irfft2(product, (m, m))
    # The highest frequency of an even length is of no certain sign: it has no derivative.
    columns = (m + 1) // 2
    values = product[:, :, :columns] / m**2
    if m % 2 == 0:
        values[:, m // 2] = 0.0
    weight = np.full(columns, 2.0)
    weight[0] = 1.0
    along_y = 2.0 * np.pi * fft.fftfreq(m)
    return _Spectrum(values, along_y, along_y[:columns].copy(), weight), whole


def correlation_along(spectrum: Complexes, frequency: Floats, shift: Floats) -> tuple[Floats, Floats, Floats]:
    """Return C (n,) and its first two derivatives at shifts (n,), from one-dimensional spectra (n, m)."""
    turned = spectrum * np.exp(1j * shift[:, None] * frequency)
    value = turned.real.sum(axis=1)
    slope = -(turned.imag @ frequency)
    bend = -(turned.real @ frequency**2)
    return value, slope, bend


def _newton(spectrum: Complexes, frequency: Floats, shift: Floats) -> tuple[Floats, Mask]:
    """Take Newton's steps to where d|C|^2 = 0 along one axis; return the shifts, and where C has a peak.

    Thesis Eq. (3.16) and (3.17): with C real, d|C|^2 = 2 C C' and d^2|C|^2 = 2 (C'^2 + C C'').
    """
    peaked = np.ones(len(shift), dtype=bool)
    for _ in range(_STEPS):
        value, slope, bend = correlation_along(spectrum, frequency, shift)
        second = slope * slope + value * bend
        peaked &= (value > 0.0) & (second < 0.0)
        step = np.where(peaked, -value * slope / np.where(peaked, second, -1.0), 0.0)
        shift = shift + np.clip(step, -0.5, 0.5)
    return shift, peaked


def sub_pixel_peak(
    spectrum: _Spectrum, tolerance: float, iterations: int
) -> tuple[Floats, Floats, NDArray[np.int32], Mask]:
    """Find the peak of |C|^2 near no shift, axis by axis.

    Returns
    -------
    u, v
        (n,), in px.
    used
        (n,), how often both axes had their turn.
    good
        (n,), whether it came to rest within the tolerance, in px.

    Notes
    -----
    Thesis Eq. (3.14)-(3.17): with v held, the two-dimensional transform is summed over its rows and what
    is left is a function of u alone, and the other way round.
    """
    n = len(spectrum.values)
    u, v = np.zeros(n), np.zeros(n)
    used = np.zeros(n, dtype=np.int32)
    good, going = np.zeros(n, dtype=bool), np.ones(n, dtype=bool)
    for _ in range(iterations):
        new_u, peaked_u = _newton(spectrum.reduced_along_y(v), spectrum.along_x, u)
        new_v, peaked_v = _newton(spectrum.reduced_along_x(new_u), spectrum.along_y, v)
        moved = np.hypot(new_u - u, new_v - v)
        u, v = np.where(going, new_u, u), np.where(going, new_v, v)
        used += going
        going &= peaked_u & peaked_v & (np.maximum(np.abs(u), np.abs(v)) < 2.0)
        good |= going & (moved < tolerance)
        going &= ~good
        if not going.any():
            break
    return u, v, used, good


def _cut(values: NDArray[np.generic], x: Ints, y: Ints, radius: int) -> tuple[NDArray[np.generic], Mask]:
    """Return squares (n, side, side) of an image about pixels, and which of their pixels lie inside it."""
    offset = np.arange(-radius, radius + 1)
    row, column = y[:, None, None] + offset[:, None], x[:, None, None] + offset
    rows, columns = values.shape
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    return values[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)], inside


def _less_mean(values: NDArray[np.generic], mask: Mask) -> tuple[Floats, Floats]:
    """Return sub-images less their means over a mask, zero elsewhere, and the means."""
    grey = np.where(mask, values, 0.0)
    mean = grey.sum(axis=(1, 2)) / np.maximum(mask.sum(axis=(1, 2)), 1)
    return np.where(mask, grey - mean[:, None, None], 0.0), mean


def _match_some(
    images: PreparedImages, x: Ints, y: Ints, guess: Floats, settings: MatchSettings, found: Matches
) -> None:
    """Do the work of `match_by_cross_correlation`, filling `found` for these points."""
    radius, least = settings.radius, least_pixels(settings)
    own, inside = _cut(images.labels, x, y, radius)
    region = inside & (own == images.labels[y, x][:, None, None])
    first = _cut(images.reference, x, y, radius)[0]
    u0, v0 = np.rint(guess[:, 0]).astype(np.int64), np.rint(guess[:, 3]).astype(np.int64)
    pending = region.sum(axis=(1, 2)) >= least
    found.ending[~pending] = TOO_FEW_PIXELS
    for cut in range(_CUTS):
        at = np.flatnonzero(pending)
        if len(at) == 0:
            return
        second, seen = _cut(images.deformed, x[at] + u0[at], y[at] + v0[at], radius)
        mask = region[at] & seen
        left = mask.sum(axis=(1, 2)) < least
        found.ending[at[left]] = LEFT_IMAGE
        f, f_mean = _less_mean(first[at], mask)
        g, g_mean = _less_mean(second, mask)
        spectrum, whole = cross_spectrum(f, g)
        v, u = _whole_peak(whole, f, g, mask)
        # The last cut is taken as it is, so that two whole pixels that are as good end somewhere.
        elsewhere = (np.maximum(np.abs(u), np.abs(v)) > 0) & ~left
        if cut < _CUTS - 1 and elsewhere.any():
            u0[at[elsewhere]] += u[elsewhere]
            v0[at[elsewhere]] += v[elsewhere]
        else:
            elsewhere[:] = False
        now = ~left & ~elsewhere
        pending[at[~elsewhere]] = False
        if now.any():
            part = _Spectrum(
                spectrum.values[now], spectrum.along_y, spectrum.along_x, spectrum.along_x_weight
            )
            grey = (f[now], g[now], f_mean[now], g_mean[now], mask[now])
            place = (x[at[now]], y[at[now]], u0[at[now]], v0[at[now]])
            _conclude(images, place, grey, part, settings, found, at[now])


def _whole_peak(whole: Floats, f: Floats, g: Floats, mask: Mask) -> tuple[Ints, Ints]:
    """Return the whole shifts (v, u) at which C is largest for the contrast of the pixels that it sums over.

    Shifts that leave fewer than half the pixels do not count.
    """
    size = (whole.shape[-1],) * 2
    seen = fft.rfft2(mask.astype(np.float64), size)
    count = fft.irfft2(np.conj(seen) * seen, size)
    first = fft.irfft2(np.conj(fft.rfft2(f * f, size)) * seen, size)
    second = fft.irfft2(np.conj(seen) * fft.rfft2(g * g, size), size)
    contrast = np.sqrt(np.maximum(first * second, 0.0))
    enough = (count > 0.5 * count[:, :1, :1]) & (contrast > 1e-6 * contrast[:, :1, :1])
    score = np.where(enough, whole / np.where(enough, contrast, 1.0), -np.inf)
    peak = np.argmax(score.reshape(len(whole), -1), axis=1)
    v, u = (np.where(p > size[0] // 2, p - size[0], p) for p in np.divmod(peak, size[0]))
    return v, u


def _conclude(
    images: PreparedImages,
    place: tuple[Ints, Ints, Ints, Ints],
    grey: tuple[Floats, Floats, Floats, Floats, Mask],
    spectrum: _Spectrum,
    settings: MatchSettings,
    found: Matches,
    at: Ints,
) -> None:
    """Refine the peaks of sub-images and enter what was found for the points `at`."""
    x, y, u0, v0 = place
    f, g, f_mean, g_mean, mask = grey
    ff, gg = (f * f).sum(axis=(1, 2)), (g * g).sum(axis=(1, 2))
    count = mask.sum(axis=(1, 2))
    variance = images.noise[0].floor + images.noise[0].slope * f_mean
    gx, gy = (np.where(mask, _cut(slope, x, y, settings.radius)[0], 0.0) for slope in _slopes(images))
    xx, xy, yy = ((a * b).sum(axis=(1, 2)) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    determinant = xx * yy - xy * xy
    textured = (ff > 4.0 * count * variance) & (gg > 0.0) & (determinant > 1e-9 * xx * yy)
    u, v, used, good = sub_pixel_peak(spectrum, settings.tolerance, settings.iterations)
    value, _, bend_x = correlation_along(spectrum.reduced_along_y(v), spectrum.along_x, u)
    bend_y = correlation_along(spectrum.reduced_along_x(u), spectrum.along_y, v)[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        score = value / np.sqrt(ff * gg)
        noise = variance + ff / gg * (images.noise[1].floor + images.noise[1].slope * g_mean)
        left_over = 2.0 * ff * (1.0 - score) / np.maximum(count - 4, 1)
        misfit = left_over / noise
        noise = np.maximum(noise, left_over)
        # The rims bend C where no texture does: as far as they do, they hold the peak back.
        scale = np.sqrt(gg / ff)
        pull_u, pull_v = u * (-bend_x / (scale * xx) - 1.0), v * (-bend_y / (scale * yy) - 1.0)
        sigma = np.sqrt(noise / determinant * np.stack([yy, xx]) + np.stack([pull_u, pull_v]) ** 2).T
    found.warp[at, 0], found.warp[at, 3] = u0 + u, v0 + v
    found.iterations[at] = used
    found.score[at] = np.where(textured, score, np.nan)
    found.ending[at] = np.where(textured, np.where(good, CONVERGED, NOT_CONVERGED), NO_TEXTURE)
    found.sigma[at] = np.where((textured & good)[:, None], sigma, np.nan)
    found.misfit[at] = np.where(textured & good, misfit, np.nan)


def _slopes(images: PreparedImages) -> tuple[Floats, Floats]:
    return images.gradient_x, images.gradient_y


def match_by_cross_correlation(
    images: PreparedImages,
    x: Ints,
    y: Ints,
    guess: Floats,
    settings: MatchSettings,
    threads: int = 1,
) -> Matches:
    """Find where the sub-images about points of the reference image lie, by a shift alone.

    Takes and returns what `correlation.match_points` does; of `guess` the shift counts, to whole pixels, and
    the slopes that are returned are zero. `settings.shape_order` has no say.

    Notes
    -----
    Thesis section 4.3.2. Step (i): where C of Eq. (3.11), for the pixels that it sums over, is largest at
    another whole pixel, the deformed sub-image is cut there again. Step (ii): the peak of |C|^2 by Newton's
    method, Eq. (3.14) and (3.15). The deformed sub-image is cut to the region of the reference, moved along
    with it. The standard deviations are those of the least-squares shift, from both images' noise or from
    what the score leaves over, whichever is more, and the pull towards whole pixels, which is estimated from
    how much more C is bent at its peak than the texture's slopes explain.
    """
    result = blank_matches(len(x), 6)
    result.warp[:] = 0.0

    def work(start: int, stop: int) -> None:
        own = np.s_[start:stop]
        part = Matches(*(values[own] for values in vars(result).values()))
        _match_some(images, x[own], y[own], guess[own], settings, part)

    in_row_blocks(work, len(x), threads, block=_BLOCK)
    return result
