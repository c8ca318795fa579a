"""Which part of a field is valid: of what could be measured, and of the whole image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Mask
from sms_jobs.records.reasons import Reason
from sms_jobs.records.statistic_names import VALID_FRACTION, VALID_FRACTION_OF_IMAGE, lost_to

_LIT = 0.01  # of the image


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
    return {VALID_FRACTION: part, VALID_FRACTION_OF_IMAGE: float(valid.mean())}


def losses(reason: NDArray[np.uint32]) -> dict[str, float]:
    """Return, where nothing is valid, by which reasons the pixels are lost; nothing where something is.

    Parameters
    ----------
    reason
        (rows, columns).

    Returns
    -------
    dict
        `lost_to_large_ray_gap` and so on: which part of the pixels has a reason, of those that are lit, or of
        the image where less than a hundredth is. A pixel may have several.
    """
    if (reason == Reason.VALID).any():
        return {}
    lit = (reason & np.uint32(Reason.LOW_MODULATION)) == 0
    counted = reason[lit] if lit.mean() > _LIT else reason.ravel()
    parts = {one: float(np.mean((counted & np.uint32(one)) != 0)) for one in Reason if one}
    return {lost_to(one): part for one, part in parts.items() if part}
