"""Which part of a field is valid: of what could be measured, and of the whole image."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.reasons import Reason

Mask: TypeAlias = NDArray[np.bool_]


def fractions(valid: Mask, measurable: Mask) -> dict[str, float]:
    """Return the statistics of a field: which part of what could be measured is valid, and of the image.

    Parameters
    ----------
    valid, measurable
        (rows, columns). Measurable is what is lit; of displacement and strain, what has a shape; of a camera
        alone, what has texture.

    Returns
    -------
    dict
        `valid_fraction`, 0 where nothing could be measured, and `valid_fraction_of_image`.
    """
    part = float((valid & measurable).sum()) / max(float(measurable.sum()), 1.0)
    return {"valid_fraction": part, "valid_fraction_of_image": float(valid.mean())}


def textured(reason: NDArray[np.uint32]) -> Mask:
    """Return the pixels of a camera alone that lie in its region and are not plain, (rows, columns)."""
    plain = np.uint32(Reason.NO_TEXTURE | Reason.OUTSIDE_REGION)
    return np.asarray((reason & plain) == 0)
