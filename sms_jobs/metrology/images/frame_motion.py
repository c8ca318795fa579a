"""Whether the scene stood still in a camera while many frames were recorded, from their mean levels.

The phase steps of a density have a mean in which the fringes are gone; what is left is the specimen as the
projector lights it. Two such means of a scene that stands still differ by noise, and by the lamp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask, Singles

_LEAST = 200  # pixels
_GRADIENT = 3.0
"""Of the image's gradient to its noise, rms: below, noise alone makes shifts look smaller than they are."""


@dataclass(frozen=True)
class ImageShifts:
    """By how much each of several images is shifted against their mean.

    Attributes
    ----------
    shift, sigma
        (images, 2), along x and y in px, and its standard deviation; NaN where the images cannot tell.
    """

    shift: Floats
    sigma: Floats


def image_shifts(images: Singles, usable: Mask, noise: float) -> ImageShifts:
    """Find the shifts of images of one scene, good to first order, for shifts below the size of its details.

    Parameters
    ----------
    images
        (images, patches, 2, columns): grey levels of small pieces of each image, two rows high.
    usable
        (patches, 2, columns): pixels that are in range in all of them.
    noise
        Standard deviation of a pixel of an image, in grey levels.

    Notes
    -----
    Image i less the mean image is -d . gradient + g times the mean image, where g is the change of the lamp;
    d and g by least squares over the pixels (Lucas and Kanade 1981, one step). What the fit leaves tells the
    scatter.
    """
    reference = images.mean(axis=0)
    across = 0.5 * (reference[..., 2:] - reference[..., :-2]).mean(axis=1)
    down = (reference[:, 1] - reference[:, 0])[:, 1:-1]
    level = reference.mean(axis=1)[:, 1:-1]
    whole: Mask = np.asarray(usable.all(axis=1))
    inside = whole[:, 2:] & whole[:, 1:-1] & whole[:, :-2]
    basis = np.stack([-across[inside], -down[inside], level[inside]]).astype(np.float64)
    unknown = np.full((len(images), 2), np.nan)
    count = basis.shape[1]
    slope = np.sqrt(np.mean(np.square(basis[:2]), axis=1)) if count else np.zeros(2)
    if count < _LEAST or slope.min() < _GRADIENT * noise / np.sqrt(len(images)):
        return ImageShifts(unknown, unknown.copy())
    inverse = np.linalg.inv(basis @ basis.T)
    difference = (images.mean(axis=2) - reference.mean(axis=1))[:, :, 1:-1][:, inside].astype(np.float64)
    found = difference @ basis.T @ inverse
    left = difference - found @ basis
    variance = np.sum(np.square(left), axis=1) / (count - 3)
    return ImageShifts(found[:, :2], np.sqrt(variance[:, None] * np.diag(inverse)[:2]))
