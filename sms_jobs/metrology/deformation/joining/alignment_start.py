"""Where two views of one specimen overlap, by their texture alone: the start of an alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.errors import MeasurementFailed
from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.calibration.rigid_alignment import align_points
from sms_jobs.metrology.compilation import in_row_blocks
from sms_jobs.metrology.deformation.joining.alignment import View
from sms_jobs.metrology.deformation.matching.seeding import masked_correlation, turned_patch
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import transform
from sms_jobs.metrology.images.texture_quality import speckle_width

_HALF_WIDTHS = 8.0  # half the side of a sub-image, in widths of the speckle's autocorrelation
_LARGEST = 6.0  # halves of the largest sub-image along the shorter side of the image
_FINE_ENOUGH = 3.0  # px: coarser speckle is searched in images of fewer pixels
_ACROSS = 8  # sub-images along the shorter side of the image
_LEAST_SCORE = 0.5  # chance alone has less in a sub-image of a hundred speckles
_TOLERANCE = 3.0  # px by which distances between found places may differ
_FEWEST = 4
_TURN = 0.12  # rad between the rotations that are tried: half of it blurs a sub-image by half a speckle


@dataclass(frozen=True)
class _Found:
    """Sub-images that were found in the other view: positions (n, 3) in mm in the frame of each."""

    here: Floats
    there: Floats


def overlapping(here: View, there: View, range_rotation: float = 0.0, threads: int = 1) -> Pose:
    """Return the motion x_here = R x_there + T that lays two views on each other, right to about a pixel.

    Parameters
    ----------
    here, there
        The views, averaged; the specimen looks much the same in both but for a shift of any size and a
        rotation in the image.
    range_rotation
        Largest rotation in the image that is looked for where none is not enough, in rad; up to 0.06 needs
        none.
    threads
        How many threads to use; the result does not depend on it.

    Raises
    ------
    MeasurementFailed
        Fewer than four sub-images are found in both at the same distances from each other.

    Notes
    -----
    Sub-images all over one view are searched in the whole of the other by normalised cross-correlation. A
    rigid motion keeps the distances between their places in space: of all that were found, those count whose
    distances agree with those of most others.
    """
    tolerance = _TOLERANCE * max(here.pitch(), there.pitch())
    most = int(range_rotation / _TURN + 0.5)
    for turn in sorted(range(-most, most + 1), key=abs):
        found = _search(here, there, turn * _TURN, threads)
        chosen = _agreeing(found, tolerance)
        if len(chosen) >= _FEWEST:
            return align_points(found.there[chosen], found.here[chosen])
    raise MeasurementFailed(
        f"fewer than {_FEWEST} sub-images are found in both views at the same distances from each other, for "
        f"rotations of up to {range_rotation:g} rad in the image; let the views overlap by more, or look for "
        "larger rotations"
    )


def _agreeing(found: _Found, tolerance: float) -> Ints:
    """Return the largest set of places, about, whose distances from each other are the same in both views."""
    if len(found.here) == 0:
        return np.zeros(0, dtype=np.int64)
    apart = [np.linalg.norm(p[:, None] - p[None], axis=2) for p in (found.here, found.there)]
    agree = np.abs(apart[0] - apart[1]) <= tolerance
    best = np.zeros(0, dtype=np.int64)
    for k in range(len(agree)):
        near = np.flatnonzero(agree[k])
        firm = near[agree[np.ix_(near, near)].mean(axis=1) > 0.5]
        if len(firm) > max(len(best), _FEWEST - 1):
            # Distances alone do not tell a shape from its mirror image.
            pose = align_points(found.there[firm], found.here[firm])
            off = np.linalg.norm(transform(pose, found.there[firm]) - found.here[firm], axis=1)
            firm = firm[off <= tolerance]
            best = firm if len(firm) > len(best) else best
    return best


def _search(here: View, there: View, angle: float, threads: int) -> _Found:
    """Find sub-images of one view in the other, those that are found clearly."""
    step, half = _scale(here)
    first, second = _coarse(here, step), _coarse(there, step)
    rows, columns = first[1].shape
    spacing = max(1, min(rows, columns) // _ACROSS)
    y, x = (a.ravel() for a in np.mgrid[half : rows - half : spacing, half : columns - half : spacing])
    places: list[tuple[int, int, int, int] | None] = [None] * len(x)

    def work(start: int, stop: int) -> None:
        for k in range(start, stop):
            if first[1][y[k], x[k]] == 0:
                continue
            template, own = turned_patch(first[0], first[1], int(x[k]), int(y[k]), half, angle)
            if own.mean() < 0.5:
                continue
            lagged = masked_correlation(template, own, second[0], second[1] > 0)
            row, column = np.unravel_index(int(np.argmax(lagged)), lagged.shape)
            if lagged[row, column] >= _LEAST_SCORE:
                places[k] = (int(y[k]), int(x[k]), int(row) + half, int(column) + half)

    if rows > 2 * half and columns > 2 * half and min(second[1].shape) > 2 * half:
        in_row_blocks(work, len(x), threads, block=4)
    kept = np.array([p for p in places if p is not None], dtype=np.int64).reshape(-1, 4)
    kept = step * kept + step // 2
    kept = kept[(here.labels[kept[:, 0], kept[:, 1]] > 0) & (there.labels[kept[:, 2], kept[:, 3]] > 0)]
    return _Found(here.xyz[:, kept[:, 0], kept[:, 1]].T, there.xyz[:, kept[:, 2], kept[:, 3]].T)


def _scale(view: View) -> tuple[int, int]:
    """Return how many pixels make one that is searched, and half the side of a sub-image in these."""
    grey = np.asarray(view.texture, dtype=np.float64)
    on = view.labels > 0
    width = speckle_width(np.where(on, grey, grey[on].mean()), 0.0) if on.any() else np.nan
    width = width if np.isfinite(width) else _FINE_ENOUGH
    step = max(1, int(width / _FINE_ENOUGH))
    return step, round(min(_HALF_WIDTHS * width, min(grey.shape) / _LARGEST) / step)


def _coarse(view: View, step: int) -> tuple[Floats, Floats]:
    """Return means of squares of a view's texture, and the labels at their middles."""
    rows, columns = (n // step for n in view.labels.shape)
    grey = np.asarray(view.texture, dtype=np.float64)[: rows * step, : columns * step]
    middle = step // 2
    labels = view.labels[middle::step, middle::step][:rows, :columns].astype(np.float64)
    return grey.reshape(rows, step, columns, step).mean(axis=(1, 3)), labels
