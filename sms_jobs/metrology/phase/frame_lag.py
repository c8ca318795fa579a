"""Whether frames hold light of the frame before or after them, and by how much that moves phases.

A projector that changes slowly, or a camera that exposes while it changes, mixes each frame with the one
beside it: (1 - a) I_k + a I_(k-1). That turns the phases of all densities alike, by -a sin(2 pi / q), and so
moves points nearly as another phase gradient would. What tells of it is that such a turn is not proportional
to the densities, and the first frame of each, which holds light of another density.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Singles
from sms_jobs.metrology.phase.frame_fit import FrameFit

Neighbour = Literal["before", "after"]
NEIGHBOURS: tuple[Neighbour, ...] = ("before", "after")


@dataclass(frozen=True)
class FrameLag:
    """What frames hold of the light of their neighbours.

    Attributes
    ----------
    neighbour
        Whether it is that of the frame before, or after.
    part
        Of all light; negative where frames hold less than none.
    sigma
        Its standard deviation; infinite where nothing tells.
    shift
        (orientations,): by how much phase gradients are too large by it in the mean, in rad per fringe.
    scatter
        (orientations,): standard deviation of that over the pixels.
    explained
        What it explains of the squared misfit of all frames and pixels, in units of noise.
    """

    neighbour: Neighbour
    part: float
    sigma: float
    shift: tuple[float, ...]
    scatter: tuple[float, ...]
    explained: float


def find_lag(
    fits: Sequence[FrameFit],
    levels: Singles,
    places: Sequence[NDArray[np.intp]],
    neighbour: Neighbour,
) -> FrameLag:
    """Find what frames hold of the light of one neighbour.

    Parameters
    ----------
    fits
        Of each orientation.
    levels
        (patterns, pixels): all that was shown, in the order of recording.
    places
        Where in it the frames of each orientation are.

    Notes
    -----
    Weighted least squares: what the frames leave unexplained is compared with what a change towards the
    neighbours would, after all that a mean, a gradient, modulations and harmonics explain of that. Pixels
    that are consistent count. The deviation is that of a sum over pixels, or over densities if that is
    larger, whatever their errors are: densities that contradict each other show something else than a lag.
    The part is right to first order.
    """
    towards = _towards(fits, levels, places, neighbour)
    products, squares, gradients = [], [], []
    for fit, own in zip(fits, places, strict=True):
        left, gradient = fit.model.unexplained(towards[own].reshape(fit.departure.shape))
        used = fit.consistent
        weight = 1.0 / np.square(fit.noise[used], dtype=np.float64)
        # (densities, pixels)
        products.append(weight * np.sum((fit.departure * left)[..., used], axis=1))
        squares.append(weight * np.sum(np.square(left[..., used]), axis=1))
        gradients.append(gradient[used] if used.any() else np.zeros(1, np.float32))
    total = float(sum(one.sum() for one in squares))
    if total == 0.0:
        nothing = (0.0,) * len(fits)
        return FrameLag(neighbour, 0.0, np.inf, nothing, nothing, 0.0)
    part = float(sum(one.sum() for one in products)) / total
    rest = [product - part * square for product, square in zip(products, squares, strict=True)]
    alone = len(rest[0]) == 1  # a single density agrees with itself
    sums = (np.concatenate([one.sum(axis=axis) for one in rest]) for axis in ((0,) if alone else (0, 1)))
    sigma = max(float(np.linalg.norm(one)) for one in sums) / total
    shift, scatter = (tuple(part * float(of(one)) for one in gradients) for of in (np.mean, np.std))
    return FrameLag(neighbour, part, sigma, shift, scatter, part**2 * total)


def _towards(
    fits: Sequence[FrameFit], levels: Singles, places: Sequence[NDArray[np.intp]], neighbour: Neighbour
) -> Singles:
    """Return what was shown beside each frame less the frame, (patterns, pixels); 0 where nothing was.

    Of frames as they were fitted: the noise that is left over would be compared with itself.
    """
    shown = levels.copy()
    for fit, own in zip(fits, places, strict=True):
        shown[own] -= fit.departure.reshape(len(own), -1)
    towards = np.zeros_like(shown)
    if neighbour == "before":
        towards[1:] = shown[:-1] - shown[1:]
    else:
        towards[:-1] = shown[1:] - shown[:-1]
    return towards


def without_lag(levels: Singles, part: float, neighbour: Neighbour) -> Singles:
    """Return what was shown, (patterns, pixels), without the part that each frame holds of a neighbour.

    The first of them, or the last, is left as it is: nothing is known of what was shown beyond.
    """
    count = len(levels)
    way = 1 if neighbour == "before" else -1
    shown = levels.copy()
    for frame in range(1, count) if way > 0 else range(count - 2, -1, -1):
        shown[frame] = (levels[frame] - part * shown[frame - way]) / (1.0 - part)
    return shown
