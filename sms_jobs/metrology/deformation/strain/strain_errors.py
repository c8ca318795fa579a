"""What displacement's errors that go together over neighbouring pixels do to strain."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.fields.noise_correlation import blended_weights
from sms_jobs.metrology.deformation.matching.finer_subsets import Subsets
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.geometry.transforms import pack, unpack

_OF_STRAIN = 0.25
"""Part of a bias that may have the shape of a strain over a gauge disc, where no subsets limit it: half of a
wave of the worst length, and half of that in the mean over its directions."""
_WIDEST = 24.0  # of a disc's radius over that of subsets: beyond, all but 4 % of what noise does is seen
_DIGITS = 3  # of the radii for which it is remembered


@dataclass(frozen=True)
class Window:
    """What a gauge sees of errors: over how many pixels, and what of filtered noise, over white noise.

    Attributes
    ----------
    pixels
        That it has.
    of_shape, of_match
        Variance of its slopes by white noise through the filter of shape, and through subsets, over that by
        white noise itself.
    """

    pixels: float
    of_shape: float
    of_match: float


@dataclass(frozen=True)
class MatchedShape:
    """Positions that come from matches between cameras, and are averages over subsets themselves.

    Attributes
    ----------
    covariance
        (6, rows, columns), of the reference positions.
    subsets
        That have been matched.
    """

    covariance: NDArray[np.floating]
    subsets: Subsets


@dataclass(frozen=True)
class SharedErrors:
    """Errors of displacement that go together over neighbouring pixels, as a gauge disc sees them.

    Attributes
    ----------
    own
        (6, rows, columns), the covariance by errors of shape and by bias that, independent from pixel to
        pixel, would disturb strain as the true one does; NaN where there is no displacement.
    match
        (6,), the same by errors of matches, everywhere alike.
    averaging_radius_px, subset_radius_px
        Distances over which errors of shape and of match go together; 0 for none.
    disc_radius_px
        Of the gauge disc, or of the disc whose points scatter as those of the gauge.
    matched
        Subsets, and which part of `match` is theirs.
    match_margin_px
        Rim of regions of which no match uses anything.
    """

    own: Floats
    match: Floats
    averaging_radius_px: float
    subset_radius_px: float
    disc_radius_px: float
    matched: tuple[tuple[Subsets, float], ...] = ()
    match_margin_px: float = 0.0

    @property
    def every(self) -> Floats:
        """(6, rows, columns), both together."""
        return self.own + self.match[:, None, None]

    def seen_by_part(self, part: float) -> tuple[float, float]:
        """Return what a disc of a part of the radius sees of `own` and of `match`, over what this one does.

        Where there is no error of shape all of `own` is bias, which is seen as a match is.
        """
        if part == 1.0 or (self.averaging_radius_px == 0.0 and not self.matched):
            return 1.0, 1.0
        match = 1.0
        if self.matched:
            match = sum(
                share
                * seen_of_match(one, part * self.disc_radius_px)
                / seen_of_match(one, self.disc_radius_px)
                for one, share in self.matched
            )
        if self.averaging_radius_px == 0.0:
            return match, match
        shape = self.averaging_radius_px / self.disc_radius_px
        return seen_of_shape(shape / part) / seen_of_shape(shape), match


def shared_errors(
    covariance: NDArray[np.floating],
    cloud_covariance: NDArray[np.floating],
    bias: NDArray[np.floating] | None = None,
    *,
    averaging_radius_px: float,
    subset_radius_px: float,
    disc_radius_px: float,
    order: ShapeOrder = 1,
    match_margin_px: float = 0.0,
    shape: MatchedShape | None = None,
    window: Window | None = None,
) -> SharedErrors:
    """Return the errors of a displacement as they disturb strain over a gauge disc.

    Parameters
    ----------
    covariance, cloud_covariance
        (6, rows, columns), of the displacement and of what of the reference positions is independent from
        pixel to pixel, in mm^2.
    bias
        (6, rows, columns), the part of the displacement's covariance that is no noise; None for none.
    averaging_radius_px, subset_radius_px
        Distances over which the displacement's errors of shape and of match go together; 0 for none.
    disc_radius_px
        Of the gauge disc, or of the disc whose points scatter as those of the gauge.
    order
        Of the deformation of the subsets of the match.
    match_margin_px
        Rim of regions of which these use nothing.
    shape
        Of positions from matches between cameras; None of others.
    window
        What the gauge sees, if it is no disc.

    Notes
    -----
    Each part is an independent error, filtered. A disc much wider than the filter sees that error in full;
    one that is not sees 1 / (1 + a q + b q^2)^2 of errors of shape, q being the filter's radius over the
    disc's, where a and b fit the exact quadrature over both filters to 10 % for q below 1.5, and of blended
    matches what their own weights tell (`seen_of_match`). The part of shape is twice the cloud's covariance
    before averaging, which divides it by 5 pi radius^2 / 9 and weighs pixels by their inverse variance, so
    that what counts is their harmonic mean; the rest is of matches, and its median is taken. Of that, twice
    the covariance of a matched shape is seen through the shape's subsets, and the remainder through those in
    time: the two have an image's noise in common, which is seen between both.

    Bias is seen as the match is. It is what the two images do not share within a subset, or what a subset
    does not follow. The former is independent where subsets do not overlap. The latter has waves of up to a
    few subsets: a longer one is followed, and a gauge that is as long itself leaves out far more of it, which
    `gauge_bias` tells. Where no subsets are known it may have the worst of all lengths.
    """
    subsets = Subsets(int(subset_radius_px), order) if subset_radius_px > 0.0 else None
    lengths = (averaging_radius_px, subset_radius_px, disc_radius_px)

    def seen(one: Subsets | None) -> float:
        """Return what the gauge sees of matches."""
        if one is None:
            return 1.0
        return seen_of_match(one, disc_radius_px) if window is None else window.of_match / _stated(one)

    noise: Floats = (covariance if bias is None else covariance - bias).astype(np.float64)
    biased: Floats = np.zeros(())
    if bias is not None:
        pixels = np.pi * disc_radius_px**2 if window is None else window.pixels
        biased = np.asarray((_OF_STRAIN * pixels if subsets is None else seen(subsets)) * bias)
    if averaging_radius_px == 0.0 and subsets is None:
        return SharedErrors(noise + biased, np.zeros(6), *lengths)
    cloud = 2.0 * _harmonic_mean(np.asarray(cloud_covariance, dtype=np.float64), averaging_radius_px)
    of_cloud = seen_of_shape(averaging_radius_px / disc_radius_px) if window is None else window.of_shape
    excess = noise - cloud / max(5.0 * np.pi / 9.0 * averaging_radius_px**2, 1.0)
    matched: list[tuple[Subsets | None, Floats]] = []
    if shape is not None:
        between = 2.0 * np.asarray(shape.covariance, dtype=np.float64)
        matched.append((shape.subsets, seen(shape.subsets) * _median(between)))
        excess -= between
    matched.append((subsets, seen(subsets) * _median(excess)))
    # What both have in common may make the remainder negative; their sum is not.
    match = _positive(sum((part for _, part in matched), start=np.zeros(6)))
    own = np.where(np.isfinite(noise), of_cloud * cloud, np.nan) + biased
    return SharedErrors(own, match, *lengths, _shares(matched), match_margin_px)


def _shares(matched: list[tuple[Subsets | None, Floats]]) -> tuple[tuple[Subsets, float], ...]:
    """Return which part of the sum of covariances (6,) each is, by their traces."""
    sizes = [
        (subsets, max(float(part[[0, 3, 5]].sum()), 0.0)) for subsets, part in matched if subsets is not None
    ]
    total = sum(size for _, size in sizes)
    if total > 0.0:
        return tuple((subsets, size / total) for subsets, size in sizes)
    return tuple((subsets, 1.0 / len(sizes)) for subsets, _ in sizes)


def _stated(subsets: Subsets) -> float:
    """Return the variance that is stated of blended matches, for pixels with a variance of 1."""
    return blended_weights(subsets)[1]


def seen_of_match(subsets: Subsets, disc_radius_px: float) -> float:
    """Return the variance of slopes over a disc by errors of blended matches, over that by independent ones.

    Both with the variance that is stated of each pixel. For a disc that is far wider it is the number of
    pixels that a match averages over.
    """
    radius = min(max(disc_radius_px, 1.0), _WIDEST * subsets.radius)
    return _seen_of_match(subsets, float(f"{radius:.{_DIGITS}g}"))


@lru_cache(maxsize=256)
def _seen_of_match(subsets: Subsets, radius: float) -> float:
    """Do the work of `seen_of_match`: the exact sum over all waves."""
    weights, stated = blended_weights(subsets)
    half = int(radius)
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    slope = np.where(x**2 + y**2 <= radius**2, x, 0.0)
    side = fft.next_fast_len(len(slope) + len(weights), real=True)
    filtered = fft.irfft2(fft.rfft2(weights, (side, side)) * fft.rfft2(slope, (side, side)), (side, side))
    return float(np.sum(filtered**2) / np.sum(slope**2)) / stated


def seen_of_shape(q: float) -> float:
    """Return what a disc sees of errors that were averaged over a radius of `q` of its own."""
    return float((1.0 + 0.40 * q + 0.41 * q**2) ** -2)


def _harmonic_mean(covariance: Floats, radius: float) -> Floats:
    """Return covariances scaled to the harmonic mean of their traces over about `radius` pixels."""
    trace = covariance[0] + covariance[3] + covariance[5]
    valid = np.isfinite(trace) & (trace > 0.0)
    inverse = np.where(valid, 1.0 / np.where(valid, trace, 1.0), 0.0)
    # A Gaussian of 0.35 radius is as wide as (1 - d^2 / radius^2)^2.
    width = 0.35 * radius
    share = ndimage.gaussian_filter(valid.astype(np.float64), width)
    mean = ndimage.gaussian_filter(inverse, width) / np.where(share > 0.0, share, 1.0)
    factor = np.where(valid, inverse / np.where(mean > 0.0, mean, 1.0), 1.0)
    return np.asarray(covariance * factor)


def _median(covariance: Floats) -> Floats:
    """Return the median of covariances (6, rows, columns), 0 where none is known."""
    finite = np.isfinite(covariance).all(axis=0)
    return np.median(covariance[:, finite], axis=1) if finite.any() else np.zeros(6)


def _positive(packed: Floats) -> Floats:
    """Return the nearest covariance that has no negative variance in any direction."""
    full = unpack(packed)
    values, vectors = np.linalg.eigh(full)
    return pack((vectors * np.maximum(values, 0.0)) @ vectors.T)
