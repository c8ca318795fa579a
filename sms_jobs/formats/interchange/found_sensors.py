"""What a calibration file was found to say, and the checks that every number passes before it is believed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime
from math import cos, isfinite, pi, radians, sin
from typing import Any

import numpy as np

from sms_jobs.errors import ConfigurationError
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import COEFFICIENTS, LENS, Intrinsics, Model
from sms_jobs.metrology.geometry.transforms import rotation_matrix
from sms_jobs.records.sensors import Box
from sms_jobs.records.views import Role

LONGEST_SIDE_PX = 20_000
LARGEST_ROTATION_ERROR = 1e-5
"""Largest departure of R R^T from 1: five decimals, as files with few digits have it."""

_EXACT = 1e-12
_OPENCV = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""OpenCV's distortion coefficients in its order: radial and tangential, rational, thin prism, tilt."""

_COUNTS = (4, 5, 8, 12, 14)
"""How many of them OpenCV writes."""

_FISHEYE = ("k1", "k2", "k3", "k4")
"""The coefficients of OpenCV's fisheye, in its order."""

_WRITTEN: dict[Model, tuple[str, ...]] = {"plain": _OPENCV[:5], "rational": _OPENCV[:8], "fisheye": _FISHEYE}

CAMERA_MODEL = f"the pin-hole with {', '.join(_OPENCV[:8])} and a skew, or OpenCV's fisheye"
_MATRIX_SIDE = 100_000
_NUMBER = re.compile(r"[-+]?(?:\d{1,40}(?:\.\d{0,40})?|\.\d{1,40})(?:[eE][-+]?\d{1,4})?")


@dataclass(frozen=True)
class FoundSensor:
    """A sensor of a file; what the file does not say is None."""

    role: Role
    intrinsics: Intrinsics
    pose: Pose
    name: str | None = None
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class FoundCalibration:
    """The sensors of a file, in its order, and what it says of the whole.

    `in_millimetres` is False for files that do not say their unit of length; `remarks` are what a person
    should know of how they were read.
    """

    sensors: tuple[FoundSensor, ...]
    in_millimetres: bool
    remarks: tuple[str, ...] = ()
    rig: str | None = None
    volume: Box | None = None
    valid_from: datetime | None = None
    origin: str | None = None


def numbers(value: Any, where: str) -> Floats:
    """Return a matrix, list or number of a file as an array; `where` names it in messages.

    Raises
    ------
    ConfigurationError
        It is none, its size contradicts its contents, or a number is not finite.
    """
    shape: tuple[int, ...] | None = None
    if isinstance(value, dict):
        shape, value = _matrix(value, where)
    flat = value if isinstance(value, list) else [value]
    if flat and all(isinstance(row, list) for row in flat):
        if any(len(row) != len(flat[0]) for row in flat):
            raise ConfigurationError(f"{where} has rows of different lengths")
        shape = (len(flat), len(flat[0])) if shape is None else shape
        flat = [number for row in flat for number in row]
    for number in flat:
        if isinstance(number, bool) or not isinstance(number, int | float):
            raise ConfigurationError(f"{where} should contain only numbers, not {str(number)[:40]!r}")
        if not isfinite(number):
            raise ConfigurationError(f"{where} holds {number}, which is not finite")
    shape = (len(flat),) if shape is None else shape
    if len(flat) != int(np.prod(shape)):
        raise ConfigurationError(
            f"{where} should hold {' x '.join(map(str, shape))} numbers, but has {len(flat)}"
        )
    return np.array(flat, dtype=np.float64).reshape(shape)


def _matrix(table: dict[str, Any], where: str) -> tuple[tuple[int, ...], Any]:
    """Return shape and numbers of OpenCV's table for a matrix, or for one of any number of dimensions."""
    sizes = table.get("sizes", [table.get("rows"), table.get("cols")])
    sizes = sizes if isinstance(sizes, list) else [sizes]
    if "data" not in table or None in sizes:
        raise ConfigurationError(f"{where} is no matrix of OpenCV: it has no rows, cols and data")
    if not sizes or not all(isinstance(n, int) and 0 <= n <= _MATRIX_SIDE for n in sizes):
        raise ConfigurationError(f"{where} has {' x '.join(map(str, sizes))} numbers, which cannot be")
    return tuple(sizes), table["data"]


def number(text: str, where: str) -> float:
    """Return the number that a text is; raise `ConfigurationError` unless it is a finite one."""
    word = text.strip()
    if not _NUMBER.fullmatch(word):
        raise ConfigurationError(f"{where} should be a number, not '{word[:40]}'")
    value = float(word)
    if not isfinite(value):
        raise ConfigurationError(f"{where} is {word[:40]}, which is beyond all numbers")
    return value


def number_list(text: str, count: int, where: str) -> Floats:
    """Return the numbers of a text, as many as there should be."""
    words = text.split()
    if len(words) != count:
        raise ConfigurationError(f"{where} should have {count} numbers, but has {len(words)}")
    return np.array([number(word, where) for word in words])


def image_size(columns: Any, rows: Any, where: str) -> tuple[int, int]:
    """Return a size of an image in px; raise `ConfigurationError` unless it is one."""
    for side in (columns, rows):
        whole = isinstance(side, int | float) and not isinstance(side, bool) and side == side // 1
        if not whole or not 1 <= side <= LONGEST_SIDE_PX:
            raise ConfigurationError(
                f"{where} says {columns} x {rows} px; sides are whole numbers from 1 to {LONGEST_SIDE_PX} px"
            )
    return int(columns), int(rows)


def intrinsics_from(matrix: Floats, coefficients: Floats, where: str, *, fisheye: bool = False) -> Intrinsics:
    """Return the inner parameters of a camera matrix and distortion coefficients in OpenCV's order.

    `fisheye` says that they are those of its fisheye.

    Raises
    ------
    ConfigurationError
        They are not those of the models of this program: `COEFFICIENTS` alone, and a small skew.
    """
    if matrix.shape != (3, 3):
        raise ConfigurationError(f"the camera matrix of {where} is {_shape(matrix)}, not 3 x 3")
    if matrix[1, 0] != 0.0 or tuple(matrix[2]) != (0.0, 0.0, 1.0):
        raise ConfigurationError(
            f"the camera matrix of {where} should be fx skew cx, 0 fy cy, 0 0 1, not {matrix.tolist()}"
        )
    if not (matrix[0, 0] > 0.0 and matrix[1, 1] > 0.0):
        raise ConfigurationError(
            f"the focal lengths of {where} should be above 0 px, not {matrix[0, 0]:g} and {matrix[1, 1]:g}"
        )
    skew, most = float(matrix[0, 1]) / float(matrix[0, 0]), LENS["skew"].high
    if not abs(skew) <= most:
        raise ConfigurationError(
            f"the skew of {where} is {matrix[0, 1]:g} px, {abs(skew):.2g} of fx, allowed is {most:g} of fx; "
            "it should be the number in the first row and second column of K"
        )
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if fisheye:
        if coefficients.size != len(_FISHEYE):
            raise ConfigurationError(
                f"{where} has {coefficients.size} distortion coefficients; OpenCV's fisheye has four, "
                f"{', '.join(_FISHEYE)}"
            )
        bent = dict(zip(_FISHEYE, map(float, coefficients.ravel()), strict=True))
        return Intrinsics(fx, fy, cx, cy, **bent, skew=skew, fisheye=1.0)
    if coefficients.size not in _COUNTS:
        raise ConfigurationError(
            f"{where} has {coefficients.size} distortion coefficients; OpenCV writes 4, 5, 8, 12 or 14"
        )
    found = dict(zip(_OPENCV, map(float, coefficients.ravel()), strict=False))
    for number, (name, value) in enumerate(found.items(), start=1):
        if value and name not in COEFFICIENTS:
            raise ConfigurationError(
                f"distortion coefficient {number} of {where}, {name}, is {value:g}, but the camera model "
                f"here is {CAMERA_MODEL}: calibrate again without other terms"
            )
    bent = {name: value for name, value in found.items() if name in COEFFICIENTS}
    return Intrinsics(fx, fy, cx, cy, **bent, skew=skew)


def opencv_coefficients(intrinsics: Intrinsics) -> Floats:
    """Return the distortion coefficients of intrinsics as OpenCV writes them."""
    return np.array([getattr(intrinsics, name) for name in _WRITTEN[intrinsics.model]])


def cardan_rotation(alpha_deg: float, beta_deg: float, gamma_deg: float) -> Floats:
    """Return Rz(gamma) Ry(beta) Rx(alpha), (3, 3): about the fixed axes x, y and z, in this order."""
    a, b, c = radians(alpha_deg), radians(beta_deg), radians(gamma_deg)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos(a), -sin(a)], [0.0, sin(a), cos(a)]])
    about_y = np.array([[cos(b), 0.0, sin(b)], [0.0, 1.0, 0.0], [-sin(b), 0.0, cos(b)]])
    about_z = np.array([[cos(c), -sin(c), 0.0], [sin(c), cos(c), 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_z @ about_y @ about_x)


def pose_from(rotation: Floats, translation: Floats, where: str) -> Pose:
    """Return the pose x = R X + T of a 3 x 3 rotation, or a rotation vector in rad, and a translation.

    A rotation that is rounded to few digits is replaced by the nearest exact one.

    Raises
    ------
    ConfigurationError
        It is no rotation within 1e-5, or the shapes are wrong.
    """
    if translation.size != 3:
        raise ConfigurationError(f"the translation of {where} is {_shape(translation)}, not 3 numbers")
    if rotation.size == 3:
        turn = float(np.linalg.norm(rotation))
        if turn > pi * (1.0 + LARGEST_ROTATION_ERROR):
            raise ConfigurationError(
                f"the rotation vector of {where} turns by {turn:.4g} rad, which is more than half a turn: "
                "is it in degrees?"
            )
        rotation = rotation_matrix(rotation.ravel())
    if rotation.shape != (3, 3):
        raise ConfigurationError(f"the rotation of {where} is {_shape(rotation)}, not 3 x 3")
    with np.errstate(all="ignore"):
        departure = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        determinant = float(np.linalg.det(rotation))
    if not departure <= LARGEST_ROTATION_ERROR or determinant < 0.0:
        raise ConfigurationError(
            f"the rotation of {where} is no right-handed rotation matrix: R R^T differs from 1 by "
            f"{departure:.2g}, allowed is {LARGEST_ROTATION_ERROR:g}, and its determinant is "
            f"{determinant:.3g}"
        )
    if departure > _EXACT:
        u, _, vt = np.linalg.svd(rotation)
        rotation = u @ vt
    return Pose.from_arrays(rotation, translation.ravel())


def _shape(array: Floats) -> str:
    return " x ".join(map(str, array.shape))
