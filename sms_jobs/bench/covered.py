"""Of what and where errors are compared with their deviations: strata of a field, means of it, and gauges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.kinds.gauge_errors import errors_of_rectangle
from sms_jobs.kinds.surface_ports import independent_covariance, position_covariance
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.deformation.fields.displacement import pixel_pitch
from sms_jobs.metrology.deformation.strain.gauges import GaugePlace, read_gauge
from sms_jobs.records.fields import DisplacementField, PhaseMaps, Surface
from sms_jobs.virtual_rig.truth import Truth

NEAR_PX = 10
"""Of an edge, a hole or a fold: a subset's radius."""
_FOLD = np.radians(10.0)
"""Between the normals at both sides of a pixel."""
_CURVED = np.radians(0.05)
"""A pixel, of the normal."""
_DIM = 0.5
"""Of the median modulation."""
_BRIGHT = 0.9
"""Of full scale, by the brightest of all frames."""
_MEAN_PX = 8
"""Side of the squares over which means of shape are taken."""
_GAUGE_MM = 15.0, 8.0
"""Length and width."""
_GAUGE_ANGLES = 0.0, np.pi / 4.0, np.pi / 2.0
_GAUGES_PX = 8
"""Between the middles of gauges."""


def strata_of(truth: Truth, phase: PhaseMaps | None, bits: int) -> dict[str, Mask]:
    """Return where what is measured belongs to; a pixel may belong to several, but for edges and holes."""
    shape = truth.shape
    expected = shape.seen & shape.lit & truth.lit_and_seen_at_end
    square = 2 * NEAR_PX + 1
    one_patch = ndimage.minimum_filter(shape.region, square) == ndimage.maximum_filter(shape.region, square)
    inner = ndimage.minimum_filter(expected, square) & one_patch
    turned = _turned(shape.normal)
    folded = ndimage.maximum_filter(np.where(np.isfinite(turned), turned, 0.0), square) > _FOLD
    smooth = inner & ~folded
    holes = ndimage.maximum_filter(ndimage.binary_fill_holes(shape.seen) & ~shape.seen, square)
    found = {
        "flat": smooth & (turned <= _CURVED),
        "curved": smooth & (turned > _CURVED),
        "fold": inner & folded,
        "hole": expected & holes,
        "edge": expected & ~inner & ~holes,
    }
    if phase is not None:
        modulation = phase.modulation.min(axis=0)
        found["dim"] = smooth & (modulation < _DIM * np.nanmedian(modulation[expected]))
        brightest = phase.mean_intensity + phase.modulation.max(axis=0)
        found["bright"] = smooth & (brightest > _BRIGHT * (2**bits - 1))
    return found


def _turned(normal: Floats) -> Floats:
    """Return by how much the normal (3, rows, columns) turns from a pixel to its neighbours, in rad."""
    steps = [np.linalg.norm(np.gradient(normal, axis=axis), axis=0) for axis in (1, 2)]
    return np.asarray(np.maximum(*steps))


def mean_scores(surface: Surface, truth: Truth) -> Floats:
    """Return the errors of means of shape over squares of pixels, in deviations, (3 n,).

    Of squares on one patch in which every pixel is valid. Noise is that of pixels which are independent, less
    what texture hides but for pixels at the rim, and the calibration's part that of the mean.
    """
    error = surface.position - truth.shape.xyz
    used = (surface.reason == 0) & np.isfinite(error).all(axis=0)
    row, column = (at % _MEAN_PX for at in np.indices(used.shape, sparse=True))
    at_rim = np.isin(row, (0, _MEAN_PX - 1)) | np.isin(column, (0, _MEAN_PX - 1))
    variance = np.where(at_rim, position_covariance(surface), independent_covariance(surface))[[0, 3, 5]]
    part = np.zeros_like(error) if surface.sigma_calibration is None else surface.sigma_calibration
    region = truth.shape.region.astype(np.float64)
    full = np.isclose(_squares(used.astype(np.float64)), 1.0) & (_squares(region**2) == _squares(region) ** 2)
    error, variance, part = (
        _squares(np.where(used, one, 0.0))[:, full] for one in (error, variance, part.astype(np.float64))
    )
    score: Floats = error / np.sqrt(variance / _MEAN_PX**2 + part**2)
    return score.ravel()


def _squares(values: Floats) -> Floats:
    """Return the means of (.., rows, columns) over squares beside each other."""
    rows, columns = (size // _MEAN_PX for size in values.shape[-2:])
    part = values[..., : rows * _MEAN_PX, : columns * _MEAN_PX]
    squares = part.reshape(*values.shape[:-2], rows, _MEAN_PX, columns, _MEAN_PX)
    return np.asarray(squares.mean(axis=(-3, -1)))


def gauge_scores(
    moved: DisplacementField, surface: Surface, labels: NDArray[np.int32], truth: Truth
) -> Floats:
    """Return the errors of what gauges read all over a surface, in deviations, (n,).

    Against what they read on the exact displacement of the same pixels.
    """
    known = np.where((moved.reason == 0) & np.isfinite(truth.displacement).all(axis=0), labels, 0)
    pitch = pixel_pitch(surface.position, known, 0.5)
    length, width = _GAUGE_MM
    every = errors_of_rectangle(moved, surface, length / pitch, width / pitch).every
    reach = int(np.ceil(length / pixel_pitch(surface.position, known, 0.05)))
    scores = []
    for row, column in zip(*np.nonzero(known), strict=True):
        if row % _GAUGES_PX or column % _GAUGES_PX:
            continue
        box = np.s_[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        x, y, _ = surface.position[:, row, column]
        near, noise = known[box], every[:, *box]
        for angle in _GAUGE_ANGLES:
            place = GaugePlace(x, y, length, width, angle)
            read = read_gauge(place, surface.position[:, *box], moved.displacement[:, *box], noise, near)
            true = read_gauge(place, truth.shape.xyz[:, *box], truth.displacement[:, *box], noise, near)
            scores.append((read.strain - true.strain) / read.sigma)
    found: Floats = np.array(scores)
    return np.asarray(found[np.isfinite(found)])
