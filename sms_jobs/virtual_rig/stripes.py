"""How bright a pattern of a Gray code is across an imperfect projector."""

from __future__ import annotations

from math import pi

import numpy as np
from scipy.ndimage import gaussian_filter1d

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.phase.patterns import stripe_brightness
from sms_jobs.records.gray_code import Stripes
from sms_jobs.records.scene import ProjectorResponse

A_PIXEL = 32
"""Values of a profile in each pixel of the projector: borders of stripes are right to 1/64 px."""


def stripe_profile(stripes: Stripes, span: float, response: ProjectorResponse) -> Singles:
    """Return the brightness of a pattern along its orientation, `A_PIXEL` values a pixel of the projector.

    Parameters
    ----------
    span
        Of the projector along the orientation, in its pixels; beyond it the outermost stripes go on.
    response
        Of the projector: visibility, exponent, and the blur of its lens.
    """
    place = np.arange(0.5, round(span * A_PIXEL), dtype=np.float64) / (span * A_PIXEL)
    omega: Floats = 2.0 * pi * (place - 0.5)
    bright = stripe_brightness(omega, stripes.bits, stripes.stripes, stripes.bit, stripes.inverted)
    sent = 0.5 * (1.0 + response.visibility * (2.0 * bright - 1.0))
    shown = sent**response.gamma
    if response.defocus_px > 0.0:
        shown = gaussian_filter1d(shown, response.defocus_px * A_PIXEL, mode="nearest")
    return np.asarray(shown, np.float32)
