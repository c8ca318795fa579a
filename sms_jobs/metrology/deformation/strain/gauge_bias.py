"""What a gauge disc leaves of strain that bends within it, told by the strain that it has found.

A slope by least squares over a disc is the mean of the slopes in it, weighted by 1 - d^2 / radius^2. Where
strain bends, that mean is not the strain in the middle, and at an edge, where half the disc is missing, not
even where strain only rises. By how much it is off is found by what the disc makes of its own result, and,
where strain bends within so little that the disc sees nothing of it, by discs of a half and a quarter of the
length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.arrays import Floats, Labels
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel, uncounted_kernel

SHORTER = (0.5, 0.25)
"""Parts of the gauge length over which strain is taken besides."""

STEPS_TO_A_RADIUS = 3
"""Samples to a radius of the disc at most, a whole number of pixels apart: 13 to 29 in a disc."""

_LEAST_VARIANCE = 1e-18  # of a strain: 1e-9 is none
PART_BY_NOISE = 0.47
"""Variance by noise of a result less the disc's mean of it, over the result's: the integral of
k^3 H^2 (1 - H)^2 over that of k^3 H^2."""

# From how many variances by noise on a mean square is no chance, and how often noise alone has it, by trial:
_SURE = 2.1  # of results less the disc's mean of them, one in a hundred to two hundred
_SURE_OF_SHORTER = 3.0  # of differences from shorter gauges, one in a thousand to three thousand
_SURE_OF_EDGE = 4.0  # of the one value that an edge adds, one in twenty, and it adds to few
_OF_EDGE = 3.2  # variance by noise of that value, over the strain's, for all of a radius: by trial
_HALF_DISC = 4.0 / (3.0 * np.pi)  # distance of a half disc's middle from its diameter, in radii
_STATISTICS = 7  # of differences: see `_squares`
_INSIDE, _AT_EDGE = 4.0 / 3.0, 2.0
"""The bias over the difference from a gauge of half the length: it goes with the square of the length where
the disc is whole, and with the length where half of it is missing."""


@dataclass(frozen=True)
class Samples:
    """Strain at every `step`-th pixel of an image, from pixel (`first`, `first`) on.

    Attributes
    ----------
    step, first
        In px of the image.
    xyz, normal
        (3, rows, columns): positions, and the surface's unit normals, 0 where they are not known.
    labels
        (rows, columns), regions; 0 for none.
    strain, variance
        (3, rows, columns), of the gauge, and its variance by noise; NaN where there is none.
    shorter
        The same two of each of the `SHORTER` gauges.
    """

    step: int
    first: int
    xyz: Floats
    normal: Floats
    labels: Labels
    strain: Floats
    variance: Floats
    shorter: tuple[tuple[Floats, Floats], ...]


@inner
@uncounted_kernel
def _in_disc(
    j: int, i: int, r: int, c: int, place: Floats, labels: Labels, square: float, least_cosine: float
) -> float:
    """Return the square of a sample's distance from another one, in radii; -1 where its disc lacks it.

    `place` (rows, columns, 6) are positions and normals.
    """
    if labels[j, i] != labels[r, c]:
        return -1.0
    dx, dy, dz = (
        place[j, i, 0] - place[r, c, 0],
        place[j, i, 1] - place[r, c, 1],
        place[j, i, 2] - place[r, c, 2],
    )
    distance = dx * dx + dy * dy + dz * dz
    if not distance <= square:
        return -1.0
    if least_cosine > -1.0:
        x, y, z = place[r, c, 3], place[r, c, 4], place[r, c, 5]
        nx, ny, nz = place[j, i, 3], place[j, i, 4], place[j, i, 5]
        known = x * x + y * y + z * z > 0.0 and nx * nx + ny * ny + nz * nz > 0.0
        if known and x * nx + y * ny + z * nz < least_cosine:
            return -1.0
    return float(distance / square)


@uncounted_kernel
def _seen_again(
    start: int, stop: int, place: Floats, labels: Labels, square: float, least_cosine: float, reach: int,
    strain: Floats, again: Floats, offset: Floats, extent: Floats,
) -> None:  # fmt: skip
    """Fill what discs make of the strain, and where their middle is in the image, for rows start .. stop.

    Of `strain` (rows, columns, 3) `again` is the mean that a slope by least squares is of slopes in a disc.
    `offset` (rows, columns, 2) is the distance of the disc's middle from its centre along columns and rows,
    `extent` (rows, columns) its rms radius, both in steps. Labels are 0 where there is no strain.
    """
    for r in range(start, stop):
        for c in range(labels.shape[1]):
            again[r, c, 0] = again[r, c, 1] = again[r, c, 2] = np.nan
            offset[r, c, 0] = offset[r, c, 1] = 0.0
            extent[r, c] = 1.0
            if labels[r, c] == 0:
                continue
            count = total = x = y = spread = xx = yy = xy = 0.0
            for j in range(max(r - reach, 0), min(r + reach + 1, labels.shape[0])):
                for i in range(max(c - reach, 0), min(c + reach + 1, labels.shape[1])):
                    near = _in_disc(j, i, r, c, place, labels, square, least_cosine)
                    if near < 0.0:
                        continue
                    weight = 1.0 - near
                    count += 1.0
                    x += i - c
                    y += j - r
                    spread += (i - c) ** 2 + (j - r) ** 2
                    total += weight
                    xx += weight * strain[j, i, 0]
                    yy += weight * strain[j, i, 1]
                    xy += weight * strain[j, i, 2]
            again[r, c, 0], again[r, c, 1], again[r, c, 2] = xx / total, yy / total, xy / total
            offset[r, c, 0], offset[r, c, 1] = x / count, y / count
            if spread > 0.0:
                extent[r, c] = np.sqrt(spread / count)


@kernel
def _means(
    start: int, stop: int, place: Floats, labels: Labels, square: float, least_cosine: float, reach: int,
    offset: Floats, values: Floats, mean: Floats, rise: Floats,
) -> None:  # fmt: skip
    """Fill means over discs of `values` (rows, columns, k), the first three of which are strains.

    And by how much strain rises to a disc's middle, (rows, columns, 3), where each strain counts as that of
    its own disc's middle, for rows start .. stop.
    """
    many = values.shape[2]
    along_x, along_y = np.empty(3), np.empty(3)
    for r in range(start, stop):
        for c in range(labels.shape[1]):
            for k in range(many):
                mean[r, c, k] = 0.0
            rise[r, c, 0] = rise[r, c, 1] = rise[r, c, 2] = 0.0
            if labels[r, c] == 0:
                continue
            count = x = y = xx = xy = yy = 0.0
            along_x[:] = 0.0
            along_y[:] = 0.0
            for j in range(max(r - reach, 0), min(r + reach + 1, labels.shape[0])):
                for i in range(max(c - reach, 0), min(c + reach + 1, labels.shape[1])):
                    if _in_disc(j, i, r, c, place, labels, square, least_cosine) < 0.0:
                        continue
                    px, py = i - c + offset[j, i, 0], j - r + offset[j, i, 1]
                    count += 1.0
                    x += px
                    y += py
                    xx += px * px
                    xy += px * py
                    yy += py * py
                    for k in range(3):
                        along_x[k] += px * values[j, i, k]
                        along_y[k] += py * values[j, i, k]
                    for k in range(many):
                        mean[r, c, k] += values[j, i, k]
            for k in range(many):
                mean[r, c, k] /= count
            xx -= x * x / count
            xy -= x * y / count
            yy -= y * y / count
            determinant = xx * yy - xy * xy
            if not determinant > 1e-4 * xx * yy:
                continue
            to_x = (yy * offset[r, c, 0] - xy * offset[r, c, 1]) / determinant
            to_y = (xx * offset[r, c, 1] - xy * offset[r, c, 0]) / determinant
            for k in range(3):
                e = mean[r, c, k]
                rise[r, c, k] = to_x * (along_x[k] - x * e) + to_y * (along_y[k] - y * e)


@uncounted_kernel
def _spread_rows(
    start: int, stop: int, labels: Labels, step: int, first: int, own: Labels, variance: Floats, reach: int,
    spread: Floats,
) -> None:  # fmt: skip
    """Fill what pixels of rows start .. stop have between the samples about them of their own region.

    Where there is none among the four nearest it is that of the nearest ones that are, within `reach` steps.
    """
    for r in range(start, stop):
        for c in range(labels.shape[1]):
            spread[:, r, c] = 0.0
            if labels[r, c] == 0:
                continue
            y, x = (r - first) / step, (c - first) / step
            top, left = int(np.floor(y)), int(np.floor(x))
            for more in range(reach + 1):
                total = 0.0
                for j in range(max(top - more, 0), min(top + more + 2, own.shape[0])):
                    for i in range(max(left - more, 0), min(left + more + 2, own.shape[1])):
                        if own[j, i] != labels[r, c] or not np.isfinite(variance[0, j, i]):
                            continue
                        # A tent, and beyond it next to nothing: the borders of the image lie there.
                        weight = max(1.0 - abs(y - j), 1e-3) * max(1.0 - abs(x - i), 1e-3)
                        total += weight
                        for k in range(3):
                            spread[k, r, c] += weight * variance[k, j, i]
                if total > 0.0:
                    for k in range(3):
                        spread[k, r, c] /= total
                    break


def part_of_shorter(part: float) -> float:
    """Return the variance by noise of a shorter gauge's result less the own one's, over the shorter one's.

    `part` is that of the gauge length. The disc's own slope is the best one of its points, so that variances
    subtract; they go with one over the fourth power of the length.
    """
    return 1.0 - part**4


def _squares(difference: Floats, noise: Floats) -> Floats:
    """Return (7, ..): squares of differences (3, ..) over variances by noise, one over these, and how many.

    Their means tell a mean square in which each sample counts by what it knows; what is not known is 0.
    """
    known = np.asarray(np.isfinite(difference).all(axis=0) & np.isfinite(noise).all(axis=0))
    weight = np.where(known, 1.0 / np.maximum(np.where(known, noise, 1.0), _LEAST_VARIANCE), 0.0)
    return np.concatenate([np.where(known, difference, 0.0) ** 2 * weight, weight, known[None]])


def _no_chance(mean: Floats, part: float, sure: float) -> Floats:
    """Return mean squares (3, ..) less those of noise, where they are no chance.

    `mean` (7, ..) are the means of what `_squares` returns. Noise has `part` of its variance, and a mean
    square of `sure` times that is no chance.
    """
    square, weight, known = mean[:3], mean[3:6], mean[6]
    divisor = np.where(weight > 0.0, weight, 1.0)
    found, noise = square / divisor, part * known / divisor
    return np.where(found > sure * noise, found - noise, 0.0)


def spread_over_pixels(variance: Floats, samples: Samples, labels: Labels, threads: int = 1) -> Floats:
    """Return a variance (3, ..) that is known at samples at every pixel of the image's regions `labels`.

    Between samples of a pixel's own region it goes from one to the next; 0 where none is within a radius.
    """
    spread = np.empty((3, *labels.shape))

    def work(start: int, stop: int) -> None:
        _spread_rows(
            start,
            stop,
            labels,
            samples.step,
            samples.first,
            samples.labels,
            variance,
            STEPS_TO_A_RADIUS,
            spread,
        )

    in_row_blocks(work, labels.shape[0], threads)
    return spread


def gauge_bias(
    samples: Samples,
    radius: float,
    reach: int,
    least_cosine: float,
    threads: int = 1,
    *,
    part_by_noise: float = PART_BY_NOISE,
) -> Floats:
    """Return the variance of strain that bends within its gauge disc, (3, rows, columns) at samples.

    Parameters
    ----------
    samples
        Strain over the gauge length, and over the shorter ones.
    radius
        Of the disc, in the unit of the samples' positions.
    reach
        The radius in steps, or more.
    least_cosine
        Between normals in a disc, as of `surface_strain`; -1 for no limit.
    threads
        How many threads to use; the result does not depend on it.
    part_by_noise
        As of `PART_BY_NOISE`, of a gauge that is no disc of that radius.

    Notes
    -----
    Of a wave of strain a disc leaves H = 8 J2(z) / z^2, z = 2 pi radius / period, which is the transform of
    the weights 1 - d^2 / radius^2. Seen by these once more it is H^2 of the wave. The result less that is
    H (1 - H) of the wave, H times what the disc has taken of it: nearly all where waves are slow (Tukey's
    twicing). Its mean square over the disc counts, less that of noise, where it is no chance.

    So do differences from shorter gauges. The error is 4 / 3 of that from a half gauge inside, where it goes
    with the square of the length, and twice that at an edge, where it goes with the length.

    At an edge a disc's middle is not its centre, and its strain is that of the middle. By how much strain
    rises on the way there follows from the strains about it, each taken as that of its own disc's middle.
    That is added to what bends; of this sum and the shorter gauges the largest counts.
    """

    def last(values: Floats) -> Floats:
        return np.ascontiguousarray(np.moveaxis(values, 0, -1))

    strain = samples.strain
    labels = np.where(np.isfinite(strain[0]), samples.labels, 0)
    shape = labels.shape
    of_disc = (last(np.concatenate([samples.xyz, samples.normal])), labels, radius**2, least_cosine, reach)
    again, offset, extent = np.empty((*shape, 3)), np.empty((*shape, 2)), np.empty(shape)
    first = last(strain)

    def see(start: int, stop: int) -> None:
        _seen_again(start, stop, *of_disc, first, again, offset, extent)

    in_row_blocks(see, len(labels), threads)
    variance = np.maximum(samples.variance, _LEAST_VARIANCE)
    every = ((np.moveaxis(again, -1, 0), variance), *samples.shorter)
    squares = [_squares(found - strain, noise) for found, noise in every]
    values = last(np.concatenate([strain, *squares]))
    mean, rise = np.empty_like(values), np.empty((*shape, 3))

    def take(start: int, stop: int) -> None:
        _means(start, stop, *of_disc, offset, values, mean, rise)

    in_row_blocks(take, len(labels), threads)
    parts = np.moveaxis(mean[..., 3:], -1, 0).reshape(len(every), _STATISTICS, *shape)
    bends = _no_chance(parts[0], part_by_noise, _SURE)
    # A whole disc has an rms radius of 1 / sqrt(2) of its radius, and so has half of one about its centre.
    aside = np.hypot(offset[..., 0], offset[..., 1]) / (np.sqrt(2.0) * extent)
    noise = _OF_EDGE * aside**2 * variance
    added = np.moveaxis(rise, -1, 0) ** 2
    found = bends + np.where(added > _SURE_OF_EDGE * noise, added - noise, 0.0)
    one_sided = np.minimum(aside / _HALF_DISC, 1.0)
    factor = (_INSIDE + (_AT_EDGE - _INSIDE) * one_sided) ** 2
    for part, one in zip(SHORTER, parts[1:], strict=True):
        found = np.maximum(found, factor * _no_chance(one, part_of_shorter(part), _SURE_OF_SHORTER))
    return np.asarray(np.where(labels > 0, found, np.nan))
