"""How a measurement is seen: one reference camera and its partners; no other module knows how it is written.

A view is written as the names of its sensors, the reference camera first: C1 for a camera alone, C1P2 for a
camera that looks at the fringes of a projector, C1C2 for cameras that look at one texture together, C1C2P1
for two cameras that look at the fringes of one projector, which only marks points for them. A sensor's name
is a letter for its role and a number.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

from sms_jobs.errors import InvalidInput


class Role(Enum):
    """What a sensor does with light."""

    CAMERA = "camera"
    PROJECTOR = "projector"


_LETTERS = {Role.CAMERA: "C", Role.PROJECTOR: "P"}
_ROLES = {letter: role for role, letter in _LETTERS.items()}
_NUMBER = "[1-9][0-9]{0,2}"
_SENSOR = re.compile(f"([{''.join(_ROLES)}])({_NUMBER})")
_VIEW = re.compile(f"(?:[{''.join(_ROLES)}]{_NUMBER})+")
CAMERA_PATTERN, PROJECTOR_PATTERN = (f"{_LETTERS[role]}{_NUMBER}" for role in Role)
"""Regular expressions of names in the names of files and folders."""
SENSOR_PATTERN = f"(?:{CAMERA_PATTERN}|{PROJECTOR_PATTERN})"
FRINGES_PATTERN = CAMERA_PATTERN + PROJECTOR_PATTERN
MOST_CAMERAS = 4
"""Of one view; a rig may have more, in several views."""


@dataclass(frozen=True)
class View:
    """One reference camera and its partners.

    Attributes
    ----------
    camera
        The sensor whose pixels the results are over.
    partners
        A projector whose fringes it sees, further cameras, or both; none for a camera alone, which
        measures in the plane of its image.
    """

    camera: str
    partners: tuple[str, ...] = ()

    def __str__(self) -> str:
        return "".join(self.sensors)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of all sensors, the reference camera first."""
        return (self.camera, *self.partners)

    @property
    def projectors(self) -> tuple[str, ...]:
        """The projectors among its partners."""
        return tuple(name for name in self.partners if role_of(name) is Role.PROJECTOR)

    @property
    def other_cameras(self) -> tuple[str, ...]:
        """The cameras among its partners."""
        return tuple(name for name in self.partners if role_of(name) is Role.CAMERA)

    @property
    def measures_shape(self) -> bool:
        """Whether there is anything but the camera to measure shape with."""
        return bool(self.partners)

    @property
    def triangulating(self) -> tuple[str, ...]:
        """The sensors whose rays meet, which have to be calibrated: of several cameras those alone."""
        return (self.camera, *self.other_cameras) if self.other_cameras else self.sensors

    @property
    def recordings(self) -> tuple[View, ...]:
        """What is recorded for it: what each camera sees, of the projector's fringes if there is one."""
        return tuple(View(name, self.projectors) for name in (self.camera, *self.other_cameras))

    @property
    def projector(self) -> str:
        """The projector whose fringes are seen; raises `InvalidInput` where there is none."""
        if not self.projectors:
            raise InvalidInput(f"the view '{self}' is not a camera with a projector; write it like C1P2")
        return self.projectors[0]


def view_of(text: str | None) -> View:
    """Read a view; raise `InvalidInput` for anything else."""
    found = [] if text is None or not _VIEW.fullmatch(text) else [*_SENSOR.finditer(text)]
    names, roles = [one[0] for one in found], [_ROLES[one[1]] for one in found]
    cameras = [Role.CAMERA] * max(min(len(roles), MOST_CAMERAS), 1)
    lit = ([Role.CAMERA, Role.PROJECTOR], [Role.CAMERA, Role.CAMERA, Role.PROJECTOR])
    if roles not in (cameras, *lit) or len({*names}) < len(names):
        raise InvalidInput(
            f"'{text or ''}' is not a view; write a camera and a projector like C1P2, two to {MOST_CAMERAS} "
            "cameras like C1C2, two cameras that see the fringes of a projector like C1C2P1, a camera alone "
            "like C1"
        )
    return View(names[0], tuple(names[1:]))


def is_view(text: str) -> bool:
    """Say whether a text is a view."""
    try:
        view_of(text)
    except InvalidInput:
        return False
    return True


def sensor_name(role: Role, number: int) -> str:
    """Return the name of a sensor; the first is 1."""
    return f"{_LETTERS[role]}{number}"


def role_of(name: str) -> Role:
    """Return the role that is written in the name of a sensor; `InvalidInput` for what is no such name."""
    found = _SENSOR.fullmatch(name)
    if found is None:
        raise InvalidInput(
            f"'{name}' cannot be the name of a sensor: cameras are C1, C2, ..., projectors P1, P2, ..."
        )
    return _ROLES[found[1]]


def place_of(name: str) -> tuple[int, int]:
    """Return by what sensors are put in order: cameras first, and each by its number."""
    return [*Role].index(role_of(name)), int(name[1:])


def place_of_view(text: str) -> tuple[tuple[int, int], ...]:
    """Return by what views are put in order: by their sensors, the reference camera first."""
    return tuple(place_of(name) for name in view_of(text).sensors)
