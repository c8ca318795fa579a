"""Mask images, read as the text by which jobs know a region of interest."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.metrology.images.region_of_interest import outlines_of, written


def region_of_mask(path: Path) -> str:
    """Return the outlines of a mask image, whose bright pixels count.

    A pixel counts when its grey level is above half of the image's brightest.

    Raises
    ------
    NotFound
        There is no such file.
    InvalidInput
        It is no image, or black all over.
    """
    if not path.is_file():
        raise NotFound(f"there is no file {path}; give a mask image whose bright pixels count")
    grey = cv2.imdecode(
        np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    )
    if grey is None:
        raise InvalidInput(f"{path} is no image that can be read; save the mask as PNG or TIFF")
    try:
        return written(outlines_of(grey > grey.max() / 2))
    except ValueError as error:
        raise InvalidInput(f"{path} cannot be a mask: {error}; paint what counts white") from error
