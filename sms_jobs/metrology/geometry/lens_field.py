"""How far out a lens is one-to-one: where its distortion folds the image over."""

from __future__ import annotations

from math import inf, pi, tan

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from sms_jobs.metrology.geometry.lens import Intrinsics, distorted

_REAL = 1e-9
_FARTHEST = 1e12
"""Square of a radius that no image shows; coefficients of next to nothing have roots beyond it."""


def _least_root(polynomial: Polynomial) -> float:
    """Return the smallest positive real root; infinite where there is none.

    The reciprocals are found: then the first coefficient, 1, leads, however small the last ones are.
    """
    found = Polynomial(polynomial.coef[::-1]).roots()
    real = found.real[(np.abs(found.imag) <= _REAL * np.abs(found)) & (found.real > 1.0 / _FARTHEST)]
    return 1.0 / float(real.max()) if len(real) else inf


def fold_radius(intrinsics: Intrinsics) -> float:
    """Return the normalised radius r = tan(theta) at which the image stops to grow; infinite where nowhere.

    Of the radial part of the lens: with the square u = r^2 and s = N(u) / D(u), r s grows where
    (N + 2 u N') D - 2 u N D' is above 0; a root of D lies at infinity in the image, and what is beyond it is
    seen nowhere. Of a fisheye it grows where its derivative by the angle is above 0, up to 90 degrees.
    """
    i = intrinsics
    if i.model == "fisheye":
        growth = Polynomial([1.0, 3.0 * i.k1, 5.0 * i.k2, 7.0 * i.k3, 9.0 * i.k4])
        angle = _least_root(growth) ** 0.5
        return tan(angle) if angle < 0.5 * pi else inf
    above, below = Polynomial([1.0, i.k1, i.k2, i.k3]), Polynomial([1.0, i.k4, i.k5, i.k6])
    twice = Polynomial([0.0, 2.0])
    growth = (above + twice * above.deriv()) * below - twice * above * below.deriv()
    fold = _least_root(growth)
    return fold**0.5 if fold < _least_root(below) else inf


def fold_px(intrinsics: Intrinsics, columns: int, rows: int) -> tuple[float, float] | None:
    """Return where a lens folds within its image, and how far the image reaches, from the principal point.

    Parameters
    ----------
    intrinsics
        Of the sensor.
    columns, rows
        Size of its image, in px.

    Returns
    -------
    Both radii in px; None for a lens that is one-to-one over the whole image.
    """
    radius = fold_radius(intrinsics)
    if radius == inf:
        return None
    corners: NDArray[np.float64] = np.array(
        [(x, y) for x in (-0.5, columns - 0.5) for y in (-0.5, rows - 0.5)]
    )
    off = corners - [intrinsics.cx, intrinsics.cy]
    focal = np.array([intrinsics.fx, intrinsics.fy])
    farthest = int(np.argmax(np.linalg.norm(off / focal, axis=1)))
    reach = float(np.linalg.norm(off[farthest]))
    straight = Intrinsics.from_vector(intrinsics.vector() * _RADIAL)
    at = float(distorted(straight.vector(), radius, 0.0)[0])
    fold = at * reach / float(np.linalg.norm(off[farthest] / focal))
    return (fold, reach) if fold < reach else None


_RADIAL = np.array([name not in ("p1", "p2", "skew") for name in Intrinsics.__dataclass_fields__], np.float64)
