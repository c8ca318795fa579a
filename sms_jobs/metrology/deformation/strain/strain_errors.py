"""What displacement's errors that go together over neighbouring pixels do to strain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.transforms import pack, unpack

_OF_STRAIN = 0.5  # part of a bias that has the shape of a strain over a gauge disc


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
class SharedErrors:
    """Errors of displacement that go together over neighbouring pixels, as a gauge disc sees them.

    Attributes
    ----------
    own
        (6, rows, columns), the covariance by errors of shape and by bias that, independent from pixel to
        pixel, would disturb strain as the true one does; NaN where there is no displacement.
    match
        (6,), the same by errors of the match, everywhere alike.
    averaging_radius_px, subset_radius_px
        Distances over which errors of shape and of match go together; 0 for none.
    disc_radius_px
        Of the gauge disc, or of the disc whose points scatter as those of the gauge.
    """

    own: Floats
    match: Floats
    averaging_radius_px: float
    subset_radius_px: float
    disc_radius_px: float

    @property
    def every(self) -> Floats:
        """(6, rows, columns), both together."""
        return self.own + self.match[:, None, None]

    def seen_by_part(self, part: float) -> tuple[float, float]:
        """Return what a disc of a part of the radius sees of `own` and of `match`, over what this one does.

        Where there is no error of shape all of `own` is bias, which counts by the disc's area.
        """
        shape, match = (
            radius / self.disc_radius_px for radius in (self.averaging_radius_px, self.subset_radius_px)
        )
        if part == 1.0 or shape == match == 0.0:
            return 1.0, 1.0
        own = seen_of_shape(shape / part) / seen_of_shape(shape) if shape > 0.0 else part**2
        return own, seen_of_match(match / part) / seen_of_match(match)


def shared_errors(
    covariance: NDArray[np.floating],
    cloud_covariance: NDArray[np.floating],
    bias: NDArray[np.floating] | None = None,
    *,
    averaging_radius_px: float,
    subset_radius_px: float,
    disc_radius_px: float,
    window: Window | None = None,
) -> SharedErrors:
    """Return the errors of a displacement as they disturb strain over a gauge disc.

    Parameters
    ----------
    covariance, cloud_covariance
        (6, rows, columns), of the displacement and of the reference positions, in mm^2.
    bias
        (6, rows, columns), the part of the displacement's covariance that is no noise; None for none.
    averaging_radius_px, subset_radius_px
        Distances over which the displacement's errors of shape and of match go together; 0 for none.
    disc_radius_px
        Of the gauge disc, or of the disc whose points scatter as those of the gauge.
    window
        What the gauge sees, if it is no disc.

    Notes
    -----
    Each part is an independent error, filtered. A disc much wider than the filter sees that error in full;
    one that is not sees 1 / (1 + a q + b q^2)^2 of it, q being the filter's radius over the disc's. The
    factors a and b fit the exact quadrature over both filters to 10 % for q below 1.5. The part of shape is
    twice the cloud's covariance before averaging, which divides it by 5 pi radius^2 / 9 and weighs pixels by
    their inverse variance, so that what counts is their harmonic mean; the rest is the match's, of which the
    median is taken, and blending makes it 1.39 times that of one subset. Bias goes together over as much as
    the whole disc: n pixels disturb the strain as n times its covariance would, independent from pixel to
    pixel, if it has the shape that strain has, and half of that is counted.
    """
    lengths = (averaging_radius_px, subset_radius_px, disc_radius_px)
    if window is None:
        window = Window(
            np.pi * disc_radius_px**2,
            seen_of_shape(averaging_radius_px / disc_radius_px),
            seen_of_match(subset_radius_px / disc_radius_px),
        )
    if bias is not None:
        noise = shared_errors(
            covariance - bias,
            cloud_covariance,
            averaging_radius_px=averaging_radius_px,
            subset_radius_px=subset_radius_px,
            disc_radius_px=disc_radius_px,
            window=window,
        )
        own = noise.own + _OF_STRAIN * window.pixels * bias
        return SharedErrors(own, noise.match, *lengths)
    if averaging_radius_px == 0.0 and subset_radius_px == 0.0:
        return SharedErrors(np.asarray(covariance, dtype=np.float64), np.zeros(6), *lengths)
    shape = 2.0 * _harmonic_mean(np.asarray(cloud_covariance, dtype=np.float64), averaging_radius_px)
    averaged = max(5.0 * np.pi / 9.0 * averaging_radius_px**2, 1.0)
    excess = covariance - shape / averaged
    finite = np.isfinite(excess).all(axis=0)
    match = _positive(np.median(excess[:, finite], axis=1)) if finite.any() else np.zeros(6)
    match *= (2.0 * subset_radius_px + 1.0) ** 2 / 1.39
    own = np.where(np.isfinite(covariance), window.of_shape * shape, np.nan)
    return SharedErrors(own, window.of_match * match, *lengths)


def seen_of_shape(q: float) -> float:
    """Return what a disc sees of errors that were averaged over a radius of `q` of its own."""
    return float((1.0 + 0.40 * q + 0.41 * q**2) ** -2)


def seen_of_match(q: float) -> float:
    """Return what a disc sees of errors that go together over subsets with a radius of `q` of its own."""
    return float((1.0 + 0.25 * q + 1.27 * q**2) ** -2)


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


def _positive(packed: Floats) -> Floats:
    """Return the nearest covariance that has no negative variance in any direction."""
    full = unpack(packed)
    values, vectors = np.linalg.eigh(full)
    return pack((vectors * np.maximum(values, 0.0)) @ vectors.T)
