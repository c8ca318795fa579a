"""What one camera alone tells of a flat specimen: displacement and strain in its image.

Everything is in pixels of the reference image, x to the right and y down, but for strain, whose y points up
as it does in `fields.StrainField`. With a scale, lengths are in mm as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.quantity import IMAGE, array

_VECTOR = ("component", *IMAGE)


@dataclass(frozen=True)
class PlanarDisplacement:
    """Displacement in the image of the material point seen by each pixel of the reference image.

    `mm_per_px` is the size of a pixel on the specimen, None where it is not known. Errors of neighbouring
    pixels go together over `subset_radius_px`.
    """

    camera: str
    reference_state: str
    subset_radius_px: int
    mm_per_px: float | None
    displacement: NDArray[np.float64] = array("px", "displacement in the image", _VECTOR, ("u", "v"))
    sigma: NDArray[np.float32] = array("px", "standard deviation of the displacement", _VECTOR, ("u", "v"))
    reason: NDArray[np.uint32] = array("bit", "why a pixel has no value, 0 where it has one")
    displacement_mm: NDArray[np.float64] | None = array(
        "mm", "displacement on the specimen", _VECTOR, ("u", "v"), default=None
    )


@dataclass(frozen=True)
class PlanarStrain:
    """Strain in the plane of the image, at each pixel of the reference image; y points up."""

    measure: str
    gauge_length_px: float
    mm_per_px: float | None
    strain: NDArray[np.float64] = array("1", "strain", _VECTOR, ("xx", "yy", "xy"))
    sigma: NDArray[np.float32] = array("1", "standard deviation of the strain", _VECTOR, ("xx", "yy", "xy"))
    principal: NDArray[np.float64] = array(
        "1", "principal strains, larger first", _VECTOR, ("first", "second")
    )
    von_mises: NDArray[np.float64] = array("1", "equivalent strain after von Mises")
    reason: NDArray[np.uint32] = array("bit", "why a pixel has no value, 0 where it has one")
