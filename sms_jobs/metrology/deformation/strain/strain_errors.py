"""What displacement's errors that go together over neighbouring pixels do to strain."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.deformation.fields.noise_correlation import blended_weights
from sms_jobs.metrology.deformation.matching.finer_subsets import Subsets
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.geometry.transforms import pack, unpack
from sms_jobs.metrology.images.masks import narrowed, wide_gaps

_OF_STRAIN = 0.25
"""Part of a bias that may have the shape of a strain over a gauge disc, where no subsets limit it: half of a
wave of the worst length, and half of that in the mean over its directions."""
_WIDEST = 24.0  # of a disc's radius over that of subsets: beyond, all but 4 % of what noise does is seen
_RIM = 1.75  # of a subset's radius: within it an edge changes the noise of a match by more than 2 %
_MOST_SQUARES = 64  # along an image, for which noise is told
_SAMPLES = 12  # along a square
_ACROSS = 0.01  # of the variance along a line, that errors along it have across at most
_LEAST = 1e-6  # of the largest variance in any direction: less is none
_DIGITS = 3  # of the radii for which it is remembered


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels, of which slopes along its length are taken: each size in px, and odd."""

    length: int
    width: int

    @classmethod
    def nearest(cls, length_px: float, width_px: float) -> Window:
        """Return the one that is nearest to a length, of three pixels at least, and to a width."""
        half, across = max(round((length_px - 1.0) / 2.0), 1), max(round((width_px - 1.0) / 2.0), 0)
        return cls(2 * half + 1, 2 * across + 1)

    def slope(self) -> Floats:
        """Return what its pixels (width, length) weigh in a slope, but for a factor."""
        half = self.length // 2
        return np.broadcast_to(np.arange(-half, half + 1.0), (self.width, self.length))


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
        (6, rows, columns), the same by errors of matches; without gaps.
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
    match: NDArray[np.float32]
    averaging_radius_px: float
    subset_radius_px: float
    disc_radius_px: float
    matched: tuple[tuple[Subsets, float], ...] = ()
    match_margin_px: float = 0.0

    @property
    def every(self) -> Floats:
        """(6, rows, columns), both together."""
        return self.own + self.match

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
    that what counts is their harmonic mean; the rest is of matches, of which medians about a place are taken
    (`_medians`). Errors of a cloud that lie along its rays are all that disturbs displacement along these
    about a place, however many times the cloud's that is: matches move points along the surface. Of the rest
    twice the covariance of a matched shape is seen through the shape's subsets, and the remainder through
    those in time: the two have an image's noise in common, which is seen between both.

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
        return seen_of_match(one, disc_radius_px) if window is None else _seen_by_window(one, window)

    noise: Floats = (covariance if bias is None else covariance - bias).astype(np.float64)
    biased: Floats = np.zeros(())
    if bias is not None:
        pixels = np.pi * disc_radius_px**2 if window is None else window.length * window.width
        biased = np.asarray((_OF_STRAIN * pixels if subsets is None else seen(subsets)) * bias)
    if averaging_radius_px == 0.0 and subsets is None:
        return SharedErrors(noise + biased, np.zeros(noise.shape, np.float32), *lengths)
    cloud = 2.0 * _harmonic_mean(np.asarray(cloud_covariance, dtype=np.float64), averaging_radius_px)
    if window is None:
        of_cloud = seen_of_shape(averaging_radius_px / disc_radius_px)
    else:
        of_cloud = _seen_through(_averaging_weights(averaging_radius_px), window.slope())
    averaged = cloud / max(5.0 * np.pi / 9.0 * averaging_radius_px**2, 1.0)
    parts: list[tuple[Subsets | None, Floats]] = [(subsets, noise)]
    if shape is not None:
        between = 2.0 * np.asarray(shape.covariance, dtype=np.float64)
        parts = [(shape.subsets, between), (subsets, noise - between)]
    widest = max((one.radius for one, _ in parts if one is not None), default=0)
    known = _far_from_edges(np.asarray(np.isfinite(parts[-1][1] - averaged).all(axis=0)), widest)
    side = _side_of_squares(max(lengths), known.shape)
    *others, (_, rest) = [(one, _medians(part, known, side)) for one, part in parts]
    of_shape = _medians(averaged, known, side)
    times = _times_along_rays(of_shape, rest)
    matched = [(one, seen(one) * part) for one, part in (*others, (subsets, rest - times * of_shape))]
    # What both have in common may make the remainder negative; their sum is not.
    told = _positive(np.sum([part for _, part in matched], axis=0))
    cloud = _between_squares(times[None], side, known.shape) * cloud
    own = np.where(np.isfinite(noise), of_cloud * cloud, np.nan) + biased
    match = _between_squares(told, side, known.shape)
    return SharedErrors(own, match, *lengths, _shares(matched), match_margin_px)


def _shares(matched: list[tuple[Subsets | None, Floats]]) -> tuple[tuple[Subsets, float], ...]:
    """Return which part of the sum of covariances (6, ...) each is, by their traces."""
    sizes = [
        (subsets, max(float(part[[0, 3, 5]].sum()), 0.0)) for subsets, part in matched if subsets is not None
    ]
    total = sum(size for _, size in sizes)
    if total > 0.0:
        return tuple((subsets, size / total) for subsets, size in sizes)
    return tuple((subsets, 1.0 / len(sizes)) for subsets, _ in sizes)


def seen_of_match(subsets: Subsets, disc_radius_px: float) -> float:
    """Return the variance of slopes over a disc by errors of blended matches, over that by independent ones.

    Both with the variance that is stated of each pixel. For a disc that is far wider it is the number of
    pixels that a match averages over.
    """
    radius = min(max(disc_radius_px, 1.0), _WIDEST * subsets.radius)
    return _seen_of_match(subsets, float(f"{radius:.{_DIGITS}g}"))


@lru_cache(maxsize=256)
def _seen_of_match(subsets: Subsets, radius: float) -> float:
    """Do the work of `seen_of_match`."""
    weights, stated = blended_weights(subsets)
    half = int(radius)
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    return _seen_through(weights, np.where(x**2 + y**2 <= radius**2, x, 0.0)) / stated


@lru_cache(maxsize=256)
def _seen_by_window(subsets: Subsets, window: Window) -> float:
    """Return what `seen_of_match` does, of slopes along a rectangle of pixels."""
    weights, stated = blended_weights(subsets)
    return _seen_through(weights, window.slope()) / stated


def _seen_through(weights: Floats, slope: Floats) -> float:
    """Return the variance of a slope by white noise through a filter, over that by the noise itself.

    Both are given by what pixels weigh (rows, columns): an exact sum over all of these.
    """
    least = np.add(weights.shape, slope.shape)
    shape = fft.next_fast_len(int(least[0])), fft.next_fast_len(int(least[1]), real=True)
    filtered = fft.irfft2(fft.rfft2(weights, shape) * fft.rfft2(slope, shape), shape)
    return float(np.sum(filtered**2) / np.sum(slope**2))


def _averaging_weights(radius: float) -> Floats:
    """Return the weights about a pixel of `average_in_region` over a radius in px, with the sum 1."""
    reach = int(np.ceil(radius))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    weight = np.maximum(1.0 - (x**2 + y**2) / max(radius, 1.0) ** 2, 0.0) ** 2
    return np.asarray(weight / weight.sum())


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


def _side_of_squares(length_px: float, shape: tuple[int, ...]) -> int:
    """Return the side of the squares for which `_medians` tells noise, of some length and so many at most."""
    return max(int(np.ceil(length_px)), -(-max(shape) // _MOST_SQUARES), 1)


def _far_from_edges(known: Mask, radius: int) -> Mask:
    """Return which known pixels are so far from edges that these change no noise, or all if none is.

    At an edge matches by subsets of a radius in px state other noise (`beside_borders`), and what that does
    to strain is told apart (`noise_at_edges`).
    """
    gaps = wide_gaps(known.astype(np.int32), max(radius, 1))
    inner = known & narrowed(~gaps, 2 * round(_RIM * radius) + 1, border_ends=True)
    return inner if inner.any() else known


def _medians(covariance: Floats, known: Mask, side: int) -> Floats:
    """Return medians of covariances (6, rows, columns) over squares and those about them, (6, y, x).

    Of known pixels (rows, columns); where there is none it is that of the nearest square, or 0. Noise changes
    slowly over an image: with light, focus, and how obliquely a surface is seen.
    """
    counts = [-(-size // side) for size in known.shape]
    every = max(1, side // _SAMPLES)
    told = np.full((6, *counts), np.nan)
    for y, x in np.ndindex(counts[0], counts[1]):
        rows = slice(max(y - 1, 0) * side, (y + 2) * side, every)
        columns = slice(max(x - 1, 0) * side, (x + 2) * side, every)
        near = covariance[:, rows, columns][:, known[rows, columns]]
        if near.size:
            told[:, y, x] = np.median(near, axis=1)
    missing = np.isnan(told[0])
    if missing.all():
        return np.zeros_like(told)
    nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(told[:, *nearest])


def _times_along_rays(part: Floats, whole: Floats) -> Floats:
    """Return how many times covariances (6, y, x) that lie along one line are part of others, (y, x).

    As often as leaves those no variance below 0 in any direction. 1 where there is nothing, or no such line.
    """
    of_part = np.linalg.eigvalsh(unpack(part))
    some = (of_part[..., 2] > 0.0) & (of_part[..., 1] < _ACROSS * of_part[..., 2])
    values, vectors = np.linalg.eigh(unpack(whole))
    some &= values[..., 2] > 0.0
    # In units of the root of the whole the largest eigenvalue of the part is 1 over that number.
    root = vectors[some] / np.sqrt(np.maximum(values, _LEAST * values[..., 2:])[some])[:, None, :]
    times = np.ones(some.shape)
    times[some] = 1.0 / np.linalg.eigvalsh(root.swapaxes(1, 2) @ unpack(part[:, some]) @ root)[:, 2]
    return times


def _between_squares(told: Floats, side: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return what is told of squares (6, y, x) for all pixels, (6, rows, columns): linear between middles."""
    down, along = (
        _shares_of_middles(size, side, count) for size, count in zip(shape, told.shape[1:], strict=True)
    )
    return np.asarray(down @ told @ along.T, dtype=np.float32)


def _shares_of_middles(size: int, side: int, count: int) -> Floats:
    """Return which part each of so many squares' middles has in each pixel along an axis, (size, count)."""
    place = np.clip((np.arange(size) + 0.5) / side - 0.5, 0.0, count - 1.0)
    return np.maximum(1.0 - np.abs(place[:, None] - np.arange(count)), 0.0)


def _positive(packed: Floats) -> Floats:
    """Return the nearest covariances (6, ...) that have no negative variance in any direction."""
    full = unpack(packed)
    values, vectors = np.linalg.eigh(full)
    return pack((vectors * np.maximum(values, 0.0)[..., None, :]) @ vectors.swapaxes(-1, -2))
