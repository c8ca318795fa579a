"""What two images say of a displacement that is told for every pixel: by how much it may be off, and where.

A displacement is laid on the images, and what they do not share is looked at in windows smaller than the
subsets that it comes from. Where the windows ask for another displacement by more than noise does, the
subsets could not follow: the surface bends, cracks or hides behind something within one of them. Where the
images differ by more than a displacement can explain, they do not show the same thing.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.compilation import in_row_blocks, kernel, variable
from sms_jobs.metrology.deformation.matching import window_maps
from sms_jobs.metrology.deformation.matching.correlation import PreparedImages, Spots
from sms_jobs.metrology.deformation.matching.slow_changes import moved_by_slow_changes
from sms_jobs.metrology.deformation.matching.subsets import RIM, blur_tensor, blurred_more
from sms_jobs.metrology.deformation.matching.window_maps import means, means_of
from sms_jobs.metrology.images.masks import box_of, narrowed, spots
from sms_jobs.metrology.images.smoothing import (
    noise_after_smoothing,
    noise_in_windows,
    noise_of_differences,
    noise_of_pixels,
)
from sms_jobs.metrology.images.spline import KERNEL_CODE, PADDING, spline_values

_WINDOW = 0.3  # radius of the windows, in subset radii: a tenth of a subset's pixels
_SCALES = (4.0, 1.0, 0.5)  # half the sides of squares over which windows are averaged, in subset radii
_ASKED_FOR = 3.0  # standard errors from which on a mean over windows is no chance
_ALONE = 4.0  # and standard deviations from which on one window is none
_AT_MOST = 2.0  # standard errors by which the mean of a smaller square bounds that of a larger one
_DISAGREE = 3.0  # variance left over, in units of the noise or, where that is more, of the median of all
_FINE = 0.4  # radius of means that are taken off what is coarse, in subset radii
_PART = 1_000_000  # pixels that are compared at a time, of which some thirty maps are kept
_LEAST_ROWS = 256  # what surrounds fewer would be most of the work
_FAR = 2.0  # px: a step of more than about a speckle's radius says nothing
_RIM = 3  # px at an image's border: its spline, bent by reflection, is off by 0.01 px there
_OTHER = 8.0  # median deviations from which on a pixel shows something else
_SAMPLE, _EVERY = 20_000, 8  # pixels that tell a median, to 2 %; of more, every so many, at most
_SPOT = 5  # px: what a bad pixel of the sensor, interpolated, is wide and high at most
_OTHERS = 0.25  # of a window's pixels that may show something else
_LIKE_ENOUGH = 0.05  # and that it may have, whatever the noise: light that changes across a fold
_LEAST_VARIANCE = 1e-12  # grey levels squared, of images that are told to have no noise
_UNLIKE = 0.36  # of a window's texture that only one image has: a correlation of 0.8
_LEFT_BY_FIT = {0: 1.0, 1: 0.6, 2: 0.45}
"""By the order of subsets, the part of a window's noise that the displacement has not followed; by trial."""
_DEPENDENT = 0.7  # of a window's pixels: neighbours that count as one; by trial
_WHOLE_BIAS = 1.25
"""Variance of the bias over that of what windows see, too large for all of it; by trial, on waves."""


@dataclass(frozen=True)
class Verified:
    """What the images say of a displacement.

    Attributes
    ----------
    bias
        (2, rows, columns), variance of u and v in px^2 beyond that of noise; 0 where nothing speaks for any.
    agrees
        (rows, columns): whether the images show the same thing there, as far as anybody can tell.
    unlike
        (rows, columns), of those that do not: whether hardly anything is the same, though most else is.
    """

    bias: Floats
    agrees: Mask
    unlike: Mask


@dataclass(frozen=True)
class _Sizes:
    """In px: radius of subsets, of windows, of means that are coarse, and of squares of windows."""

    subset: int
    window: int
    coarse: int
    squares: tuple[int, ...]

    @classmethod
    def of(cls, radius: int) -> _Sizes:
        """Return what goes with subsets of a radius."""
        window = max(2, round(_WINDOW * radius))
        squares = tuple(max(window, round(scale * radius)) for scale in _SCALES)
        return cls(radius, window, max(2, round(_FINE * radius)), squares)


@dataclass(frozen=True)
class _Noise:
    """Factors on noise: of a pixel, of what windows see, of differences, and as if it were white.

    `left_by_fit` is the part of the windows' that the displacement has not followed; at the image's border,
    where it is carried, it has followed none.
    """

    pixel: float
    window: float
    rough: float
    white: float
    left_by_fit: float


@kernel
def _carry(top: int, left: int, coefficients: Floats, code: int, image: Floats, carried: Floats) -> None:
    """Fill a part of the deformed image where the displacement leads to, NaN for and at the images' borders.

    The part's first pixel is (`top`, `left`) of the reference image.
    """
    rows, columns = image.shape[1:]
    stride = coefficients.shape[1]
    last_column, last_row = stride - 2 * PADDING - 1, coefficients.shape[0] - 2 * PADDING - 1
    first = np.empty(columns, dtype=np.int64)
    s, t, values = np.empty(columns), np.empty(columns), np.empty(columns)
    where = np.empty(columns, dtype=np.int64)
    for r in range(rows):
        count = variable(0)
        carried[r] = np.nan
        if top + r < _RIM or top + r > last_row - _RIM:
            continue
        for c in range(max(_RIM - left, 0), min(last_column + 1 - _RIM - left, columns)):
            x, y = left + c + image[0, r, c], top + r + image[1, r, c]
            if not (x >= _RIM and y >= _RIM and x <= last_column - _RIM and y <= last_row - _RIM):
                continue
            column, row = np.int64(x + PADDING), np.int64(y + PADDING)
            s[count] = x + PADDING - column
            t[count] = y + PADDING - row
            first[count] = (row - 2) * stride + column - 2
            where[count] = c
            count += 1
        spline_values(coefficients, code, count, first, s, t, values)
        for k in range(count):
            carried[r, where[k]] = values[k]


@kernel
def _see_as_deformed(
    image: Floats, gradient_x: Floats, gradient_y: Floats, spots: Spots, seen: Floats
) -> None:
    """Blur or sharpen the reference image's grey levels `seen` as a displacement's slopes tell."""
    rows, columns = seen.shape
    for r in range(1, rows - 1):
        for c in range(1, columns - 1):
            ux, uy = image[0, r, c + 1] - image[0, r, c - 1], image[0, r + 1, c] - image[0, r - 1, c]
            vx, vy = image[1, r, c + 1] - image[1, r, c - 1], image[1, r + 1, c] - image[1, r - 1, c]
            if np.isfinite(ux + uy + vx + vy):
                tensor = blur_tensor(spots, 0.5 * ux, 0.5 * uy, 0.5 * vx, 0.5 * vy)
                seen[r, c] += blurred_more(gradient_x, gradient_y, r, c, tensor)


def _left_over(
    f: Floats, g: Floats, known: Mask, trusted: Mask, radius: int
) -> tuple[Floats, Floats, Floats]:
    """Return f - b g and the gain b as zero-normalised matching has them in a subset, and f less its mean.

    Means and gain are those of the `trusted` pixels: one that shows something else is no light.
    """
    f = np.ascontiguousarray(f)
    products = tuple(np.empty(f.shape) for _ in range(4))
    window_maps.trusted_products(f, g, trusted, *products)
    weight = means(trusted.astype(np.float64), radius)
    residual, gain, texture = (np.empty(f.shape) for _ in range(3))
    f_means, g_means, gg, fg = (means(one, radius) for one in products)
    window_maps.without_light(f, g, known, weight, (f_means, g_means, gg, fg), residual, gain, texture)
    return residual, gain, texture


def _mean_square(
    asked: Floats, spread: Floats, known: Mask, told: Mask, inner: Mask, sizes: _Sizes
) -> Floats:
    """Return the mean square of what windows ask for, (rows, columns) in px^2, beyond the variance by noise.

    Windows count by what they know. A mean over a square counts where it is significant; that over a larger
    square does so too, as far as the smaller ones leave room for it. What is not `inner` is judged by its
    smallest square alone, and judges nothing else: there matches are carried to the image's border. That is
    left out where no displacement is `told` for any such pixel.
    """
    usable = known & (spread > 0.0) & (np.abs(asked) < _FAR)  # neither is true of NaN
    asked, noise = np.where(usable, asked, 0.0), np.where(usable, spread, 1.0)
    typical = float(np.median(noise[usable])) if usable.any() else 1.0
    # Running sums do not bear weights of very different sizes.
    maps = tuple(np.empty(asked.shape) for _ in range(3))
    window_maps.weighed(asked, noise, usable & inner, typical, *maps)
    found = np.zeros(asked.shape)
    for scale in sizes.squares:
        found = _bounded(found, maps, scale, sizes.window)
    if (told & ~inner).any():
        window_maps.weighed(asked, noise, usable, typical, *maps)
        found = np.where(inner, found, _bounded(found, maps, sizes.squares[-1], sizes.window))
    square = asked**2
    alone = usable & (square > _ALONE**2 * noise)
    return np.maximum(found, np.where(alone, square, 0.0))


def _bounded(found: Floats, maps: tuple[Floats, ...], scale: int, window: int) -> Floats:
    """Return the mean square over squares, or `found` as far as it has room, where that is no chance."""
    independent = (2 * scale + 1) ** 2 / (_DEPENDENT * (2 * window + 1) ** 2)
    bound = np.empty(found.shape)
    weight, excess, chance = (means(one, scale) for one in maps)
    window_maps.bounded(found, (weight, excess, chance), independent, _ASKED_FOR, _AT_MOST, bound)
    return bound


def _made_by_images(asked: Floats, noises: Floats, across: Floats, known: Mask, radius: int) -> Floats:
    """Return by how much more than noise windows ask for along unit vectors, as a variance, at least 1."""
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = (across * asked).sum(axis=0) ** 2 / (across**2 * noises).sum(axis=0)
    usable = known & np.isfinite(squares) & (np.abs(asked) < _FAR).all(axis=0)
    return np.fmax(means_of(np.minimum(squares, _ALONE**2), usable, radius), 1.0)


def _roughness(residual: Floats, variance: Floats, known: Mask, radius: int) -> Floats:
    """Return by how much more than noise residuals scatter from pixel to pixel, at least 1.

    In the mixed fourth difference, in which what differs over some pixels hardly shows.
    """
    rough = np.zeros_like(residual)
    rows = residual[:-2] - 2.0 * residual[1:-1] + residual[2:]
    rough[1:-1, 1:-1] = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    inner = narrowed(known, 3, border_ends=True)
    squares = rough**2 / variance
    everywhere = float(np.mean(squares[inner])) if inner.any() else 1.0
    return np.maximum(np.nan_to_num(means_of(squares, inner, radius), nan=everywhere), 1.0)


def verify_displacement(
    images: PreparedImages,
    image: Floats,
    radius: int,
    order: int,
    smoothing_px: float,
    threads: int = 1,
    *,
    across: Floats | None = None,
) -> Verified:
    """Compare the images along a displacement that subsets have measured.

    Parameters
    ----------
    images
        The two images, with the noise that `match_points` is told.
    image
        (2, rows, columns): u and v in px, NaN where there is none.
    radius, order
        Of the subsets: half their side in px, and the order of their deformation.
    smoothing_px
        Standard deviation of the filter that both images have passed.
    threads
        How many threads to use; the result does not depend on it.
    across
        (2, rows, columns), unit vectors in the reference image along which no shape of what is seen can move
        a match, NaN where none is known; None where a displacement may be off in any direction.

    Notes
    -----
    In every window of a tenth of a subset's pixels the residual r = f - b g(x + u) asks for the displacement
    d = (sum J J^T)^-1 sum J r (a Gauss-Newton step). The variance of d by noise is known; what the square of
    d has more is bias: of the shape function, of blending, of what only one image shows. It is averaged over
    neighbouring windows as far as its own significance allows. The sum of r^2 over a window, in units of the
    noise, tells where the images differ: more than three times what noise or, where the noise is not well
    known, the median window has.

    What windows ask for `across` is made by the images alone: by noise, by lenses, by texture that is sampled
    coarsely. By how much more that is than noise, in the mean over the largest squares, noise is taken to be
    more in both directions.
    """
    known = np.asarray(np.isfinite(image).all(axis=0))
    sizes = _Sizes.of(radius)
    noise = _factors(images, known, smoothing_px, sizes.window, _LEFT_BY_FIT[order])
    inner = np.zeros_like(known)
    inner[RIM:-RIM, RIM:-RIM] = True
    bias = np.zeros(image.shape)
    misfit = np.full(known.shape, np.nan, dtype=np.float32)
    halo = max(sizes.squares) + sizes.window + radius
    rows, columns = box_of(known)

    def work(start: int, stop: int) -> None:
        start, stop = start + rows.start, stop + rows.start
        top, bottom = max(start - halo, rows.start), min(stop + halo, rows.stop)
        part = slice(top, bottom), columns
        ways = None if across is None else across[:, *part]
        square, left_over = _in_part(images, image, inner, part, sizes, noise, ways)
        own = np.s_[start - top : stop - top]
        bias[:, start:stop, columns] = _WHOLE_BIAS * square[:, own]
        misfit[start:stop, columns] = left_over[own]

    in_row_blocks(work, rows.stop - rows.start, threads, _rows_of_parts(rows, columns, halo))
    misfit[~inner] = np.nan
    judged = np.abs(misfit[~np.isnan(misfit)])
    usual = max(1.0, float(np.median(judged))) if len(judged) else 1.0
    np.copyto(bias, 0.0, where=~known)
    with np.errstate(invalid="ignore"):
        agrees = ~(misfit > _DISAGREE * min(usual, 1e6))
    # The outermost windows reach over from pixels that are alike.
    unlike = narrowed(np.isposinf(misfit), 3) & (usual <= _DISAGREE)
    return Verified(bias, agrees, unlike)


def _rows_of_parts(rows: slice, columns: slice, halo: int) -> int:
    """Return the rows of the even parts that a box is cut into, so that each stays small with its halo."""
    height: int = rows.stop - rows.start
    most: int = max(_LEAST_ROWS, _PART // max(columns.stop - columns.start, 1) - 2 * halo)
    parts = max(1, ceil(height / most))
    return max(1, ceil(height / parts))


def _factors(
    images: PreparedImages, known: Mask, smoothing_px: float, window: int, left_by_fit: float
) -> _Noise:
    """Return what of the noise that matching is told a pixel has, and windows see."""
    told = noise_after_smoothing(images.reference, known, smoothing_px)
    part = box_of(known)
    slopes = [np.where(known[part], slope[part], 0.0) for slope in (images.gradient_x, images.gradient_y)]
    seen = float(np.mean([noise_in_windows(slope, smoothing_px, window) for slope in slopes]))
    return _Noise(
        noise_of_pixels(smoothing_px) / told,
        left_by_fit * seen / told,
        noise_of_differences(smoothing_px) / told,
        1.0 / told,
        left_by_fit,
    )


def _variance(images: PreparedImages, f: Floats, g: Floats, gain: Floats) -> Floats:
    """Return the variance of f - b g by what matching is told of both images' noise."""
    first, second = images.noise
    noise = float(first.floor), float(first.slope), float(second.floor), float(second.slope)
    variance = np.empty(g.shape)
    window_maps.variances(np.ascontiguousarray(f), g, gain, noise, _LEAST_VARIANCE, variance)
    return variance


def _in_part(
    images: PreparedImages,
    image: Floats,
    inner: Mask,
    part: tuple[slice, slice],
    sizes: _Sizes,
    noise: _Noise,
    across: Floats | None,
) -> tuple[Floats, Floats]:
    """Return for rows and columns the mean square of what windows ask for (2, ..), and their misfit."""
    f = _seen_as_deformed(images, image, part)
    g = np.empty(f.shape)
    code = KERNEL_CODE[images.interpolant]
    _carry(part[0].start, part[1].start, images.coefficients, code, image[:, *part], g)
    # The rim of a region, which is not matched, mixes with what lies behind it.
    known = np.isfinite(g) & (images.labels[part] > 0)
    g = np.where(known, g, 0.0)
    coarse = _left_over(f, g, known, known, max(sizes.squares))[0]
    residual, gain, texture = _left_over(f, g, known, _alike(coarse, known), sizes.subset)
    like = _alike(residual, known)
    gx, gy = (np.where(known, slope[part], 0.0) for slope in (images.gradient_x, images.gradient_y))
    variance = _variance(images, f, g, gain)
    roughness = _roughness(residual, noise.rough * variance, known, sizes.subset)
    asked, spread = _asked_for(gx, gy, residual, noise.window * variance, sizes.window)
    noises = np.where(inner[part], 1.0, 1.0 / noise.left_by_fit) * roughness * spread
    if across is not None:
        noises *= _made_by_images(asked, noises, across, known & inner[part], max(sizes.squares))
    told = np.asarray(np.isfinite(image[:, *part]).all(axis=0))
    square = np.stack(
        [_mean_square(a, n, known, told, inner[part], sizes) for a, n in zip(asked, noises, strict=True)]
    )
    slow_x, slow_y, slow = (means(one, sizes.coarse) for one in (gx, gy, residual))
    parts = zip((gx, gy, residual), (slow_x, slow_y, slow), strict=True)
    x, y, fine = (np.where(like, one - mean, 0.0) for one, mean in parts)
    fine_asked, spread = _asked_for(x, y, fine, noise.pixel * variance, sizes.subset)
    window_maps.raise_where_sure(fine_asked, spread, roughness, known, _ALONE, square)
    white = roughness * noise.white * variance
    radii = (sizes.subset, sizes.coarse)
    moved = moved_by_slow_changes(residual, (gx, gy), (slow_x, slow_y), white, like, known, radii)
    np.maximum(square, moved, out=square)
    if (other := spots(known & ~like, _SPOT)).any():  # which have pulled the match by what they ask for
        pulled, _ = _asked_for(gx, gy, np.where(other, residual, 0.0), variance, sizes.subset)
        np.maximum(square, pulled**2, out=square)
    squares = np.empty(residual.shape)
    window_maps.mended_squares(residual, asked, (gx, gy), (like, known), _FAR, squares)
    return square, _misfit(squares, texture, noise.pixel * variance, roughness, known, like, sizes.window)


def _seen_as_deformed(images: PreparedImages, image: Floats, part: tuple[slice, slice]) -> Floats:
    """Return a part of the reference image, as blurred as the deformed one is."""
    f = images.reference[part]
    if not any(images.spots):
        return f
    seen = f.copy()
    _see_as_deformed(image[:, *part], images.gradient_x[part], images.gradient_y[part], images.spots, seen)
    return seen


def _alike(residual: Floats, known: Mask) -> Mask:
    """Return the known pixels whose residual is no outlier among them: they show one thing in both images."""
    squares = residual**2
    own = squares[known]
    sample = own[:: min(max(1, len(own) // _SAMPLE), _EVERY)]  # within a subset of each other
    return known & (squares <= _OTHER**2 * (float(np.median(sample)) if len(sample) else 0.0))


def _contrast(square: Floats, texture: Floats, part: Floats, window: int) -> Floats:
    """Return the variance of a texture about its mean in windows, as a share of the whole window's.

    The texture is 0 where it is not known; `square` are the means of its square, `part` those of what is.
    """
    return np.maximum(square - means(texture, window) ** 2 / part, 0.0)


def _misfit(
    squares: Floats,
    texture: Floats,
    variance: Floats,
    roughness: Floats,
    known: Mask,
    like: Mask,
    window: int,
) -> Floats:
    """Return means over windows of squared residuals, in variances; infinite where hardly anything is alike.

    With a minus where what differs is little beside the texture, whatever the noise; NaN where nothing is
    known, where texture and squares are 0. Single pixels that show something else are no matter.
    """
    whole = np.maximum(means(known.astype(np.float64), window), 1e-12)
    part = np.maximum(means(like.astype(np.float64), window), 1e-12)
    relative = np.where(like, squares / np.where(like, variance, 1.0), 0.0)
    misfit = means(relative, window) / part
    left = means(np.where(like, squares, 0.0), window)
    alike = np.where(like, texture, 0.0)
    alike_square = means(alike**2, window)
    misfit[left < _LIKE_ENOUGH * _contrast(alike_square, alike, part, window)] *= -1.0
    misfit[(left > _UNLIKE * alike_square) & (misfit > _DISAGREE * roughness)] = np.inf
    contrast = _contrast(means(texture**2, window), texture, whole, window)
    every = means(squares, window) > _LIKE_ENOUGH * contrast
    misfit[every & (part < (1.0 - _OTHERS) * whole)] = np.inf
    misfit[~known] = np.nan
    return misfit


def _asked_for(
    gx: Floats, gy: Floats, residual: Floats, variance: Floats, radius: int
) -> tuple[Floats, Floats]:
    """Return the displacement (2, ..) in px that windows about each pixel ask for, and its variance."""
    xx, xy, yy = (means(a * b, radius) for a, b in ((gx, gx), (gx, gy), (gy, gy)))
    along_x, along_y = means(gx * residual, radius), means(gy * residual, radius)
    asked, spread = np.empty((2, *variance.shape)), np.empty((2, *variance.shape))
    pixels = (2 * radius + 1) ** 2
    window_maps.solved((xx, xy, yy), (along_x, along_y), variance, pixels, asked, spread)
    return asked, spread
