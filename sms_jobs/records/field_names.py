"""How quantities of fields are called where people choose them: values of a mesh, maps, columns."""

from __future__ import annotations

from typing import Final

from sms_jobs.records.quantity import STRAIN_COMPONENTS, Axes

POSITION: Final = "position"
DISPLACEMENT_LENGTH: Final = "displacement"
DEVIATION_VALUE: Final = "deviation"
VON_MISES: Final = "von_mises"
TEXTURE: Final = "texture"
"""Formats with colours show it as grey: 0 is black, 1 the camera's full scale."""


def component(quantity: str, which: str) -> str:
    """Return how a component of a quantity is called, as 'displacement X'."""
    return f"{quantity} {which}"


def along(axes: Axes, quantity: str) -> tuple[str, str, str]:
    """Return how the components of a vector are called along the axes of the world or of the specimen."""
    x, y, z = axes
    return component(quantity, x), component(quantity, y), component(quantity, z)


def sigma_of(name: str) -> str:
    """Return how the standard deviation of what has a name is called."""
    return f"sigma of {name}"


POSITION_XYZ: Final = along("XYZ", POSITION)
DISPLACEMENT_XYZ: Final = along("XYZ", DISPLACEMENT_LENGTH)
DISPLACEMENT_IN_SPECIMEN: Final = along("xyz", DISPLACEMENT_LENGTH)
DISPLACEMENT_SIGMA: Final = sigma_of(DISPLACEMENT_LENGTH)
SIGMA_CALIBRATION: Final = f"{DISPLACEMENT_SIGMA} from the calibration"
"""Of what was measured with a calibration that says how well it is known."""
STRAIN_VALUES: Final = tuple(component("strain", which) for which in STRAIN_COMPONENTS)
PRINCIPAL_STRAINS: Final = (component("principal", "first"), component("principal", "second"))
IN_SPACE: Final = (DISPLACEMENT_XYZ[2], SIGMA_CALIBRATION)
"""Values that the image of a camera alone has not: it has no depth and takes no calibration."""
MERGED_VALUES: Final = (
    *DISPLACEMENT_XYZ,
    DISPLACEMENT_LENGTH,
    DISPLACEMENT_SIGMA,
    SIGMA_CALIBRATION,
    *STRAIN_VALUES,
    *map(sigma_of, STRAIN_VALUES),
    *PRINCIPAL_STRAINS,
    VON_MISES,
    TEXTURE,
)
"""Every value that the merged surface of a state can have."""
DEVIATION_OVER_SIGMA: Final = f"{DEVIATION_VALUE} over sigma"
