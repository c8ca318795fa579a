"""How values that are computed from others follow from them, for headers that people read."""

from __future__ import annotations

from sms_jobs.records.field_names import (
    DEVIATION_OVER_SIGMA,
    DEVIATION_VALUE,
    DISPLACEMENT_LENGTH,
    DISPLACEMENT_SIGMA,
    PRINCIPAL_STRAINS,
    SIGMA_CALIBRATION,
    STRAIN_VALUES,
    TEXTURE,
    VON_MISES,
    sigma_of,
)

_XX, _YY, _XY = STRAIN_VALUES
_FIRST, _SECOND = PRINCIPAL_STRAINS

FORMULAS = {
    DISPLACEMENT_LENGTH: "sqrt(X^2 + Y^2 + Z^2)",
    DISPLACEMENT_SIGMA: "sqrt(CXX + CYY + CZZ), C the covariance of the displacement",
    SIGMA_CALIBRATION: f"sqrt(SX^2 + SY^2 + SZ^2) from the calibration, no part of {DISPLACEMENT_SIGMA}",
    "covariance": "1 sigma squared",
    _XX: "tension positive, x the specimen's x axis in the surface's tangent plane",
    _YY: "tension positive, y across the specimen in the surface's tangent plane",
    _XY: "tensor component = engineering shear / 2",
    _FIRST: "(xx + yy) / 2 + sqrt(((xx - yy) / 2)^2 + xy^2)",
    _SECOND: "(xx + yy) / 2 - sqrt(((xx - yy) / 2)^2 + xy^2)",
    VON_MISES: "sqrt(e1^2 - e1 e2 + e2^2) of the principal strains",
    DEVIATION_VALUE: "distance to the reference surface, positive outside the material",
    DEVIATION_OVER_SIGMA: f"{DEVIATION_VALUE} / {sigma_of(DEVIATION_VALUE)}",
    TEXTURE: "grey level / the camera's full scale",
}
"""By the name of a value of a mesh, or by field and component of a record."""


def with_formula(name: str, label: str) -> str:
    """Return a label with the formula of what it names, where that is computed from other columns."""
    formula = FORMULAS.get(name)
    return label if formula is None else f"{label}: {formula}"
