"""Cameras, projectors, the rig they form, and its calibration."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from itertools import combinations, product

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import LENS, Intrinsics, foreign
from sms_jobs.records.numbers import checked_number
from sms_jobs.records.texts import checked_text
from sms_jobs.records.times import checked_time
from sms_jobs.records.views import Role, View, role_of, sensor_name

FARTHEST_MM = 1e7
LARGEST_SIDE_PX = 1 << 16
_NAME_LETTERS = 8


def _check_size(name: str, columns: int, rows: int) -> None:
    checked_text(name, "the name of a sensor", _NAME_LETTERS)
    for side, what in ((columns, "columns"), (rows, "rows")):
        checked_number(side, f"the number of {what} of sensor {name}", 1, LARGEST_SIDE_PX)


def _check_model(name: str, intrinsics: Intrinsics) -> None:
    if intrinsics.fisheye not in (0.0, 1.0):
        raise InvalidInput(
            f"fisheye of sensor {name} is {intrinsics.fisheye:g}: give 1 for a fisheye, 0 for any other lens"
        )
    for key in foreign(intrinsics.model):
        value = getattr(intrinsics, key)
        if value:
            raise InvalidInput(
                f"sensor {name} is a {intrinsics.model}, which has no {key}, but {key} is {value:g}: give 0"
            )


@dataclass(frozen=True)
class SensorFormat:
    """The name of a sensor and the size of its image in pixels: what is known before a calibration."""

    name: str
    columns: int
    rows: int

    def __post_init__(self) -> None:
        _check_size(self.name, self.columns, self.rows)


@dataclass(frozen=True)
class Sensor:
    """A camera or a projector.

    Attributes
    ----------
    name
        C1, C2, ... for cameras, P1, P2, ... for projectors.
    role
        Camera or projector.
    columns, rows
        Size of its image, in pixels.
    intrinsics, pose
        See `sms_jobs.metrology.geometry.lens` and `camera`.
    """

    name: str
    role: Role
    columns: int
    rows: int
    intrinsics: Intrinsics
    pose: Pose

    def __post_init__(self) -> None:
        _check_size(self.name, self.columns, self.rows)
        if role_of(self.name) is not self.role:
            raise InvalidInput(
                f"sensor {self.name} is a {self.role.value}: call it {sensor_name(self.role, 1)}, "
                f"{sensor_name(self.role, 2)}, ..."
            )
        for key, known in LENS.items():
            what = f"{key} of sensor {self.name}" + (", in px" if known.unit == "px" else "")
            checked_number(getattr(self.intrinsics, key), what, known.low, known.high)
        _check_model(self.name, self.intrinsics)
        for value in self.pose.translation:
            checked_number(value, f"a translation of sensor {self.name}, in mm", -FARTHEST_MM, FARTHEST_MM)


@dataclass(frozen=True)
class Rig:
    """Cameras and projectors that stand together.

    Attributes
    ----------
    name
        Unique in the catalogue.
    sensors
        Cameras first, each group in order of name.
    """

    name: str
    sensors: tuple[Sensor, ...]

    def sensor(self, name: str) -> Sensor:
        """Return the sensor of that name; raise `InvalidInput` where there is none."""
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        known = ", ".join(s.name for s in self.sensors)
        raise InvalidInput(f"rig {self.name} has no sensor {name}; it has {known}")

    def views(self) -> tuple[str, ...]:
        """Return every view of a camera and a projector, C1P1, C1P2, ..., or without one of two cameras."""
        cameras = [s.name for s in self.sensors if s.role is Role.CAMERA]
        projectors = [s.name for s in self.sensors if s.role is Role.PROJECTOR]
        pairs = product(cameras, projectors) if projectors else combinations(cameras, 2)
        return tuple(str(View(camera, (partner,))) for camera, partner in pairs)


@dataclass(frozen=True)
class Box:
    """The measurement volume: a box along the world's axes, corners in mm."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        for value in (*self.low, *self.high):
            checked_number(value, "a corner of the volume, in mm", -FARTHEST_MM, FARTHEST_MM)

    @property
    def diagonal_mm(self) -> float:
        """Length of the space diagonal, in mm."""
        return float(np.linalg.norm(np.subtract(self.high, self.low)))


@dataclass(frozen=True)
class Calibration:
    """The parameters of every sensor of a rig, valid from a time on.

    Attributes
    ----------
    rig
        The sensors as they were found to be.
    volume
        The measurement volume, in the world's frame.
    valid_from
        With time zone.
    origin
        How it came about, in words: "exact parameters of the virtual rig", "bundle adjustment of ...".
    """

    rig: Rig
    volume: Box
    valid_from: datetime
    origin: str

    def __post_init__(self) -> None:
        checked_time(self.valid_from, f"valid_from of the calibration of rig {self.rig.name}")
        checked_text(self.origin, f"the origin of the calibration of rig {self.rig.name}")
