"""What virtual strain gauges read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.quantity import XYZ, array

_GAUGES = ("gauge",)


@dataclass(frozen=True)
class GaugeReadings:
    """Strain under virtual gauges at one state, seen by one view or one camera.

    NaN where fewer than twelve pixels lie under a gauge's grid. A camera alone knows places in its image;
    those in mm, with Y upwards from the first pixel, only where a pixel's size is known.
    """

    measure: str
    names: tuple[str, ...]
    strain: NDArray[np.float64] = array("1", "strain along the gauge", _GAUGES)
    sigma: NDArray[np.float32] = array("1", "standard deviation of the strain", _GAUGES)
    place: NDArray[np.float64] = array(
        "mm", "middle of the grid in the specimen's frame", ("gauge", "component"), XYZ
    )
    pixels: NDArray[np.int32] = array("1", "number of pixels under the grid", _GAUGES)
    place_px: NDArray[np.float64] | None = array(
        "px",
        "middle of the grid in the reference image of a camera alone",
        ("gauge", "component"),
        ("column", "row"),
        default=None,
    )
    sigma_calibration: NDArray[np.float32] | None = array(
        "1",
        "standard deviation from the calibration alone, which is no part of sigma",
        _GAUGES,
        default=None,
    )
