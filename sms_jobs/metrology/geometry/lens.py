"""The lens model, in one place: its parameters, its equations and their derivatives.

A lens maps the direction of a ray, the normalised point (x, y) = (X / Z, Y / Z) in the sensor's frame, to a
distorted point (x', y'), which the focal lengths and the principal point scale to pixels; what lies 90
degrees from the axis or more is out of its reach. Cameras and projectors share three models, OpenCV's, and
the skew of the pixels: plain, Brown's polynomial; rational, that polynomial over another one; and fisheye,
where the image grows with the angle to the axis instead of its tangent. The number of parameters, their order
and their names in every array, table, file and report follow from `Intrinsics`.

To put another model here:

1. Declare its parameters: the fields of `Intrinsics`, after all that are there, and its name in `Model`; tell
   it from the others in `Intrinsics.model` and `is_plain`.
2. Write its equations: `distorted`, `by_point`, `by_parameters` and, where the inverse needs another place to
   begin, `newton_start`, which are compiled too; and where it folds, in `lens_field.py`.
3. Write them a second time in `virtual_rig/optics.py`, which stays a witness of its own.
4. Say how other programs write it: in `formats/interchange/found_sensors.py` where OpenCV has other names or
   another order for its coefficients, and in `geometry/thesis_parameters.py` where k1, k2 and k3 are no
   longer those of a polynomial.

`tests/unit/geometry/test_lens.py` checks the derivatives of whatever model stands here,
`tests/unit/test_virtual_rig_optics.py` compares it with the witness; `test_interchange_calibrations.py` and
`test_foreign_stereo_calibrations.py` each name a file that is refused for coefficients beyond it.
`docs/equations.md` has the equations, `docs/conventions.md` the parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, TypeAlias, TypeVar, get_args, get_type_hints

import numpy as np

from sms_jobs.metrology.arrays import Floats

Coordinate = TypeVar("Coordinate", float, Floats)

_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-14  # in units of the focal length: five orders below a nanometre at a metre
_ANGLE_STEPS = 8  # from a radius that is off by half: each squares what is left
_TINY = 1e-300  # on top of a square, so that the axis needs no case of its own

Model: TypeAlias = Literal["plain", "rational", "fisheye"]
MODELS: tuple[Model, ...] = get_args(Model)
"""Names of the lens models."""


@dataclass(frozen=True)
class Parameter:
    """What is known of a parameter of a lens before any calibration.

    Attributes
    ----------
    meaning
        In words, for reports.
    group
        What it is part of: parameters of one group mean the same to a person.
    unit
        px, or 1.
    low, high
        Its limits.
    poses
        From how many poses of a board on its first value is found; infinite where only an adjustment of
        everything finds it.
    plausible
        Standard deviation of what lenses have, which keeps away what a few poses do not tell.
    models
        Those that have it.
    estimated
        Those whose adjustment finds it by default.
    held
        Whether a session keeps it whatever else it is told to estimate: it comes from other programs alone.
    """

    meaning: str
    group: str
    unit: str = "1"
    low: float = -1e7
    high: float = 1e7
    poses: float = float("inf")
    plausible: float = float("inf")
    models: tuple[Model, ...] = MODELS
    estimated: tuple[Model, ...] = MODELS
    held: bool = False


_BROWN: tuple[Model, ...] = ("plain", "rational")
_RICHER: tuple[Model, ...] = ("rational", "fisheye")
_RATIONAL: tuple[Model, ...] = ("rational",)


@dataclass(frozen=True)
class Intrinsics:
    """The inner parameters of a sensor: those of the pin-hole, then the coefficients of its distortion."""

    fx: Annotated[float, Parameter("focal length along x", "focal length", "px", 1.0, poses=1)]
    fy: Annotated[float, Parameter("focal length along y", "focal length", "px", 1.0, poses=1)]
    cx: Annotated[float, Parameter("principal point, x", "principal point", "px", poses=2)]
    cy: Annotated[float, Parameter("principal point, y", "principal point", "px", poses=2)]
    k1: Annotated[float, Parameter("radial, r^2", "distortion", poses=1, plausible=1.0)] = 0.0
    k2: Annotated[float, Parameter("radial, r^4", "distortion", poses=2, plausible=1.0)] = 0.0
    p1: Annotated[
        float, Parameter("tangential, along y", "distortion", plausible=0.1, models=_BROWN, estimated=_BROWN)
    ] = 0.0
    p2: Annotated[
        float, Parameter("tangential, along x", "distortion", plausible=0.1, models=_BROWN, estimated=_BROWN)
    ] = 0.0
    k3: Annotated[float, Parameter("radial, r^6", "distortion", plausible=1.0, estimated=_RICHER)] = 0.0
    skew: Annotated[float, Parameter("skew, of y'", "skew", "1", -0.1, 0.1, estimated=(), held=True)] = 0.0
    k4: Annotated[
        float,
        Parameter(
            "radial, r^2 of the divisor; r^8 of a fisheye",
            "distortion",
            plausible=1.0,
            models=_RICHER,
            estimated=_RICHER,
        ),
    ] = 0.0
    k5: Annotated[
        float,
        Parameter(
            "radial, r^4 of the divisor", "distortion", plausible=1.0, models=_RATIONAL, estimated=_RATIONAL
        ),
    ] = 0.0
    k6: Annotated[
        float,
        Parameter(
            "radial, r^6 of the divisor", "distortion", plausible=1.0, models=_RATIONAL, estimated=_RATIONAL
        ),
    ] = 0.0
    fisheye: Annotated[
        float,
        Parameter("1 for a fisheye", "model", "1", 0.0, 1.0, models=("fisheye",), estimated=(), held=True),
    ] = 0.0

    @classmethod
    def from_vector(cls, values: Floats) -> Intrinsics:
        """Return the intrinsics that `vector` makes these values (parameters,) of."""
        return cls(*map(float, values))

    def vector(self) -> Floats:
        """Return all parameters, (parameters,), in the order of `LENS`."""
        return np.array([getattr(self, name) for name in LENS])

    def distortion(self) -> Floats:
        """Return the coefficients of the distortion, in the order of `COEFFICIENTS`."""
        return self.vector()[PIN_HOLE:]

    @property
    def model(self) -> Model:
        """Return the model that the values are of: the plainest that has them."""
        if self.fisheye > 0.5:
            return "fisheye"
        return "rational" if self.k4 or self.k5 or self.k6 else "plain"

    def matrix(self) -> Floats:
        """Return the 3 x 3 matrix K; its skew is in px."""
        return np.array([[self.fx, self.fx * self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


LENS: dict[str, Parameter] = {
    name: hint.__metadata__[0] for name, hint in get_type_hints(Intrinsics, include_extras=True).items()
}
"""The parameters of a lens by name, in their order."""

PER_LENS = len(LENS)
"""Number of parameters of a lens."""

PIN_HOLE = 4
"""Number of those of the pin-hole: fx, fy, cx and cy stand first, whatever the distortion."""

COEFFICIENTS = tuple(LENS)[PIN_HOLE:]
"""Names of the coefficients of the distortion."""


def fixed_by_default(model: Model) -> tuple[str, ...]:
    """Return the names of those that an adjustment of a model keeps fixed by default."""
    return tuple(name for name, parameter in LENS.items() if model not in parameter.estimated)


def foreign(model: Model) -> tuple[str, ...]:
    """Return the names of those that a model does not have."""
    return tuple(name for name, parameter in LENS.items() if model not in parameter.models)


KEPT = fixed_by_default("plain")
"""Names of those that an adjustment of plain lenses keeps fixed by default."""

HELD = tuple(name for name, parameter in LENS.items() if parameter.held)
"""Names of those that sessions always keep."""


def is_plain(lens: Floats) -> bool:
    """Say whether a `vector` of intrinsics is that of a plain lens."""
    return bool(lens[10] == 0.0 and lens[11] == 0.0 and lens[12] == 0.0 and not lens[13] > 0.5)


def plainly_distorted(lens: Floats, x: Coordinate, y: Coordinate) -> tuple[Coordinate, Coordinate]:
    """Return what `distorted` does, of a plain lens."""
    k1, k2, p1, p2, k3, skew = lens[4], lens[5], lens[6], lens[7], lens[8], lens[9]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    down = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + skew * down, down


def distorted(lens: Floats, x: Coordinate, y: Coordinate) -> tuple[Coordinate, Coordinate]:
    """Return the distorted point (x', y') of a normalised one; `lens` is a `vector` of intrinsics.

    x' = x s + 2 p1 x y + p2 (r^2 + 2 x^2) + skew y' and y' = y s + p1 (r^2 + 2 y^2) + 2 p2 x y, where
    s = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), or, of a fisheye, with the angle
    theta = atan(r), s = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r
    (Brown 1966, Claus and Fitzgibbon 2005, Kannala and Brandt 2006, Eq. (6), all as in OpenCV; thesis
    Eq. (1.22) is the radial part of the first; the skew is that of K, in units of fx).
    For numbers in kernels, and for arrays.
    """
    if is_plain(lens):
        return plainly_distorted(lens, x, y)
    k1, k2, p1, p2, k3, skew = lens[4], lens[5], lens[6], lens[7], lens[8], lens[9]
    k4, k5, k6 = lens[10], lens[11], lens[12]
    r2 = x * x + y * y
    if lens[13] > 0.5:
        r = np.sqrt(r2 + _TINY)
        angle = np.arctan(r)
        a2 = angle * angle
        radial = angle / r * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
    else:
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    down = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + skew * down, down


def plainly_by_point(
    lens: Floats, x: Coordinate, y: Coordinate
) -> tuple[Coordinate, Coordinate, Coordinate, Coordinate]:
    """Return what `by_point` does, of a plain lens."""
    k1, k2, p1, p2, k3, skew = lens[4], lens[5], lens[6], lens[7], lens[8], lens[9]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    cross = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    down = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return (
        radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + skew * cross,
        cross + skew * down,
        cross,
        down,
    )


def by_point(
    lens: Floats, x: Coordinate, y: Coordinate
) -> tuple[Coordinate, Coordinate, Coordinate, Coordinate]:
    """Return dx'/dx, dx'/dy, dy'/dx and dy'/dy of `distorted`: derivatives of thesis Eq. (1.22)."""
    if is_plain(lens):
        return plainly_by_point(lens, x, y)
    k1, k2, p1, p2, k3, skew = lens[4], lens[5], lens[6], lens[7], lens[8], lens[9]
    k4, k5, k6 = lens[10], lens[11], lens[12]
    r2 = x * x + y * y
    if lens[13] > 0.5:
        r = np.sqrt(r2 + _TINY)
        angle = np.arctan(r)
        a2 = angle * angle
        radial = angle / r * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        grown = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))
        slope = (grown / (1.0 + r2) - radial) / (r2 + _TINY)
    else:
        divisor = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / divisor
        above, below = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3), k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)
        slope = 2.0 * (above - radial * below) / divisor
    cross = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    down = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return (
        radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + skew * cross,
        cross + skew * down,
        cross,
        down,
    )


def by_parameters(lens: Floats, x: Coordinate, y: Coordinate, rows: Floats) -> None:
    """Fill rows (2, coefficients, ...) with the derivatives of x' and y' by the coefficients."""
    k1, k2, p1, p2, k3, skew = lens[4], lens[5], lens[6], lens[7], lens[8], lens[9]
    k4, k5, k6 = lens[10], lens[11], lens[12]
    r2 = x * x + y * y
    if lens[13] > 0.5:
        r = np.sqrt(r2 + _TINY)
        angle = np.arctan(r)
        a2 = angle * angle
        share = angle / r
        radial = share * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        first, second, third, below = share * a2, share * a2 * a2, share * a2 * a2 * a2, 0.0 * radial
        fourth = third * a2
    else:
        share = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        radial = share * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))
        first, second, third, below = share * r2, share * (r2 * r2), share * (r2 * r2 * r2), -radial
        fourth = below * first
    rows[0, 0], rows[1, 0] = x * first, y * first
    rows[0, 1], rows[1, 1] = x * second, y * second
    rows[0, 2], rows[1, 2] = 2.0 * x * y, r2 + 2.0 * y * y
    rows[0, 3], rows[1, 3] = r2 + 2.0 * x * x, 2.0 * x * y
    rows[0, 4], rows[1, 4] = x * third, y * third
    rows[0, 5], rows[1, 5] = 0.0, 0.0
    rows[0, 6], rows[1, 6] = x * fourth, y * fourth
    rows[0, 7], rows[1, 7] = x * below * second, y * below * second
    rows[0, 8], rows[1, 8] = x * below * third, y * below * third
    rows[0, 9], rows[1, 9] = 0.0, 0.0
    for k in range(9):
        rows[0, k] += skew * rows[1, k]
    rows[0, 5] = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y


def newton_start(lens: Floats, u: Coordinate, v: Coordinate) -> tuple[Coordinate, Coordinate]:
    """Return the normalised point from which Newton's method finds that of a distorted one, (u, v).

    Of a fisheye it is the point itself but for rounding, found in the angle, in which the lens is nearly a
    straight line; NaN from 90 degrees on. Of other lenses it is (u, v).
    """
    if not lens[13] > 0.5:
        return u, v
    k1, k2, k3, k4 = lens[4], lens[5], lens[8], lens[10]
    across = u - lens[9] * v
    length = np.sqrt(across * across + v * v + _TINY)
    angle, grown = length, length
    for _ in range(_ANGLE_STEPS):
        a2 = angle * angle
        bent = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        grown = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))
        angle = angle - (bent - length) / grown
    # Roots are none from 90 degrees on, and where the image does not grow with the angle.
    scale = np.sin(angle) / (np.sqrt(np.cos(angle)) ** 2 * length) + 0.0 * np.sqrt(grown)
    return across * scale, v * scale


def distort(intrinsics: Intrinsics, points: Floats) -> Floats:
    """Distort normalised points (..., 2), x/z and y/z: `distorted` for arrays."""
    return np.stack(distorted(intrinsics.vector(), points[..., 0], points[..., 1]), axis=-1)


def distortion_jacobian(intrinsics: Intrinsics, points: Floats) -> Floats:
    """Return d(distorted)/d(normalised), (..., 2, 2), at normalised points (..., 2)."""
    rows = np.stack(by_point(intrinsics.vector(), points[..., 0], points[..., 1]), axis=-1)
    return rows.reshape(*points.shape, 2)


def pixel_jacobian(intrinsics: Intrinsics, points: Floats) -> Floats:
    """Return d(pixel)/d(parameters of the lens), (n, 2, parameters), at normalised points (n, 2)."""
    lens, x, y = intrinsics.vector(), points[:, 0], points[:, 1]
    rows = np.zeros((len(x), 2, PER_LENS))
    rows[:, 0, 0], rows[:, 1, 1] = distorted(lens, x, y)
    rows[:, 0, 2] = rows[:, 1, 3] = 1.0
    by_parameters(lens, x, y, rows[:, :, PIN_HOLE:].transpose(1, 2, 0))
    rows[:, :, PIN_HOLE:] *= lens[:2, None]
    return rows


def undistort(intrinsics: Intrinsics, points: Floats) -> Floats:
    """Invert `distort` by Newton's method.

    Parameters
    ----------
    intrinsics
        Of the sensor.
    points
        (..., 2), distorted.

    Returns
    -------
    (..., 2), normalised; NaN where the iteration does not converge (outside the lens's valid field).
    """
    target = np.asarray(points, dtype=np.float64)
    lens = intrinsics.vector()
    with np.errstate(all="ignore"):
        found = np.stack(newton_start(lens, target[..., 0], target[..., 1]), axis=-1)
        determinant = np.ones(target.shape[:-1])
        for _ in range(_NEWTON_STEPS):
            residual = distort(intrinsics, found) - target
            if np.nanmax(np.abs(residual), initial=0.0) < _NEWTON_TOLERANCE:
                break
            j = distortion_jacobian(intrinsics, found)
            determinant = j[..., 0, 0] * j[..., 1, 1] - j[..., 0, 1] * j[..., 1, 0]
            dx = (j[..., 1, 1] * residual[..., 0] - j[..., 0, 1] * residual[..., 1]) / determinant
            dy = (j[..., 0, 0] * residual[..., 1] - j[..., 1, 0] * residual[..., 0]) / determinant
            found -= np.stack([dx, dy], axis=-1)
        off = np.max(np.abs(distort(intrinsics, found) - target), axis=-1)
        found[~((off <= 1e-9) & (determinant > 0.0))] = np.nan  # beyond a fold the picture is turned over
    return found
