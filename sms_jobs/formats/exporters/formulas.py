"""How values that are computed from others follow from them, for headers that people read."""

from __future__ import annotations

from sms_jobs.records.fields import SIGMA_CALIBRATION

FORMULAS = {
    "displacement": "sqrt(X^2 + Y^2 + Z^2)",
    "sigma of displacement": "sqrt(CXX + CYY + CZZ), C the covariance of the displacement",
    SIGMA_CALIBRATION: "sqrt(SX^2 + SY^2 + SZ^2) from the calibration, no part of sigma of displacement",
    "covariance": "1 sigma squared",
    "strain xx": "tension positive, x the specimen's x axis in the surface's tangent plane",
    "strain yy": "tension positive, y across the specimen in the surface's tangent plane",
    "strain xy": "tensor component = engineering shear / 2",
    "principal first": "(xx + yy) / 2 + sqrt(((xx - yy) / 2)^2 + xy^2)",
    "principal second": "(xx + yy) / 2 - sqrt(((xx - yy) / 2)^2 + xy^2)",
    "von_mises": "sqrt(e1^2 - e1 e2 + e2^2) of the principal strains",
    "deviation": "distance to the reference surface, positive outside the material",
    "deviation over sigma": "deviation / sigma of deviation",
    "texture": "grey level / the camera's full scale",
}
"""By the name of a value of a mesh, or by field and component of a record."""


def with_formula(name: str, label: str) -> str:
    """Return a label with the formula of what it names, where that is computed from other columns."""
    formula = FORMULAS.get(name)
    return label if formula is None else f"{label}: {formula}"
