"""What is known of a state seconds after it was recorded, at reduced resolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.quantity import XYZ, array

_GAUGES = ("gauge",)
_VECTORS = ("gauge", "component")


@dataclass(frozen=True)
class QuickLook:
    """What a quick look at a state has found; it is no result, and nothing is computed from it.

    Attributes
    ----------
    reference_state
        That it was compared with; empty where it was compared with none.
    step_px
        Every which pixel, along rows and columns, has got a position.
    doubts
        What is wrong with the recording, in words; empty for one without blemish.
    names
        Of the gauges; none where it was compared with nothing.
    """

    reference_state: str
    step_px: int
    doubts: tuple[str, ...]
    names: tuple[str, ...]
    place: NDArray[np.float64] = array("mm", "middle of the gauge in the specimen's frame", _VECTORS, XYZ)
    displacement: NDArray[np.float64] = array("mm", "displacement of the gauge's middle", _VECTORS, XYZ)
    sigma: NDArray[np.float32] = array("mm", "standard deviation of the displacement", _VECTORS, XYZ)
    extension: NDArray[np.float64] = array("mm", "growth of the distance of the gauge's ends", _GAUGES)
    extension_sigma: NDArray[np.float32] = array("mm", "standard deviation of the extension", _GAUGES)
    reason: NDArray[np.uint32] = array("bit", "why a gauge has no value, 0 where it has one", _GAUGES)
