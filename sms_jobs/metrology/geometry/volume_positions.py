"""Where a bar and a plate stand in a measurement volume, so that its whole is tried."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats

Vector = tuple[float, float, float]

_FORE_AND_AFT = 0.6
"""Of the half depth that is free: where what stands in front and behind has its middle."""
_TILT_DEG = 20.0


@dataclass(frozen=True)
class Position:
    """Where an artefact stands.

    Attributes
    ----------
    label, words
        Of the state, and for whoever puts it there.
    rotation_rad, middle_mm
        From the artefact's frame into the world: a rotation vector, and where its middle is.
    """

    label: str
    words: str
    rotation_rad: Vector
    middle_mm: Vector


def bar_positions(low: Vector, high: Vector, length_mm: float, radius_mm: float) -> tuple[Position, ...]:
    """Return seven positions of a bar along z of its own frame, in a box (3,) to (3,) in mm.

    Along X and Y through the middle, along both diagonals of the front, along two diagonals of space, and
    along X behind. Raises `InvalidInput` where the bar does not fit in one of them.
    """
    size, middle = np.subtract(high, low), 0.5 * np.add(high, low)
    x, y, z = np.eye(3)
    front = size[0] * x + size[1] * y, size[0] * x - size[1] * y
    space = size * [1, 1, 1], size * [1, -1, 1]
    fore = _FORE_AND_AFT * (0.5 * size[2] - radius_mm) * z
    wanted = (
        ("along X, in the middle", x, 0.0 * z),
        ("along Y, in the middle", y, 0.0 * z),
        ("along the rising diagonal of X and Y, in front", front[0], fore),
        ("along the falling diagonal of X and Y, in front", front[1], fore),
        ("along the rising diagonal of space", space[0], 0.0 * z),
        ("along the falling diagonal of space", space[1], 0.0 * z),
        ("along X, behind", x, -fore),
    )
    found = []
    for number, (words, along, off) in enumerate(wanted, start=1):
        direction = along / np.linalg.norm(along)
        reach = np.abs(0.5 * length_mm * direction) + radius_mm + np.abs(off)
        if (reach > 0.5 * size).any():
            raise InvalidInput(
                f"a bar of {length_mm:g} mm with spheres of {2 * radius_mm:g} mm does not fit {words} in a "
                f"volume of {' x '.join(f'{s:g}' for s in size)} mm; test with a shorter one"
            )
        rotation, _ = Rotation.align_vectors(direction[None], z[None])
        found.append(_position(f"B{number:02d}", words, rotation, middle + off))
    return tuple(found)


def plane_positions(
    low: Vector, high: Vector, width_mm: float, height_mm: float, towards: Floats
) -> tuple[Position, ...]:
    """Return six positions of a plate whose normal is z of its own frame, in a box (3,) to (3,) in mm.

    In the middle, behind and in front, facing `towards` (3,), where the cameras are; and turned there by 20
    degrees about either axis. Raises `InvalidInput` where the plate does not fit.
    """
    size, middle = np.subtract(high, low), 0.5 * np.add(high, low)
    facing = towards - middle
    facing = facing / np.linalg.norm(facing)
    right = np.cross([0.0, 1.0, 0.0], facing)
    right /= np.linalg.norm(right)
    upright = Rotation.from_matrix(np.stack([right, np.cross(facing, right), facing], axis=1))
    corners = np.array([[width_mm, height_mm, 0.0], [width_mm, -height_mm, 0.0]]) / 2.0
    found = []
    wanted = (
        ("facing, in the middle", 0.0, 0.0, 0.0),
        ("facing, in front", 0.0, 0.0, 1.0),
        ("facing, behind", 0.0, 0.0, -1.0),
        ("turned to the right, in the middle", 0.0, _TILT_DEG, 0.0),
        ("turned to the left, in the middle", 0.0, -_TILT_DEG, 0.0),
        ("turned up, in the middle", -_TILT_DEG, 0.0, 0.0),
    )
    for number, (words, about_x, about_y, side) in enumerate(wanted, start=1):
        rotation = upright * Rotation.from_euler("xy", [about_x, about_y], degrees=True)
        reach = np.abs(rotation.apply(corners)).max(axis=0)
        free = 0.5 * size - reach
        if (free < 0.0).any():
            raise InvalidInput(
                f"a plate of {width_mm:g} x {height_mm:g} mm does not fit {words} in a volume of "
                f"{' x '.join(f'{s:g}' for s in size)} mm; test with a smaller one"
            )
        steps = free / np.maximum(np.abs(facing), 1e-9)
        off = side * _FORE_AND_AFT * float(steps.min()) * facing
        found.append(_position(f"P{number:02d}", words, rotation, middle + off))
    return tuple(found)


def _position(label: str, words: str, rotation: Rotation, middle: Floats) -> Position:
    a, b, c = (float(v) for v in rotation.as_rotvec())
    x, y, z = (float(v) for v in middle)
    return Position(label, words, (a, b, c), (x, y, z))
