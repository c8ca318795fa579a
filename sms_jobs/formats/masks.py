"""Mask images, read as the text by which jobs know a region of interest."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.importers.image_files import read_image
from sms_jobs.metrology.images.region_of_interest import outlines_of, written

_MOST_PIECES = 1000


@dataclass(frozen=True)
class MaskRegion:
    """What of a mask image counts, in its pixels.

    Attributes
    ----------
    text
        Its outlines, as jobs take them.
    columns, rows
        Of the image, which those that are to be measured have to have.
    """

    text: str
    columns: int
    rows: int


def region_of_mask(path: Path, above: float | None = None, least_px: int = 0) -> MaskRegion:
    """Return the outlines of a mask image, whose bright pixels count.

    Parameters
    ----------
    path
        Of the image.
    above
        Pixels count whose grey level is higher; half of the image's brightest if not given. A picture whose
        background was painted black is a mask above 0.
    least_px
        Pieces and holes of fewer pixels are left out.

    Raises
    ------
    NotFound
        There is no such file.
    InvalidInput
        It is no image, or nothing of it counts.
    """
    if not path.exists():
        raise NotFound(f"there is no file {path}; give a mask image whose bright pixels count")
    grey, _ = read_image(path)
    inside = np.asarray(grey > (grey.max() / 2 if above is None else above))
    inside = ~_large(~_large(inside, least_px), least_px)
    pieces = ndimage.label(inside)[1] + ndimage.label(~inside)[1]
    if pieces > _MOST_PIECES:
        raise InvalidInput(
            f"{path} has {pieces} pieces and holes, a region may have {_MOST_PIECES}: leave out small ones, "
            "for example with `least_px` 20"
        )
    try:
        return MaskRegion(written(outlines_of(inside)), *inside.shape[::-1])
    except ValueError as error:
        raise InvalidInput(f"{path} cannot be a mask: {error}; paint what counts white") from error


def _large(inside: NDArray[np.bool_], least_px: int) -> NDArray[np.bool_]:
    """Return the pieces of at least so many pixels."""
    if least_px < 2:
        return inside
    labels, _ = ndimage.label(inside)
    large = np.bincount(labels.ravel()) >= least_px
    large[0] = False
    return np.asarray(large[labels])
