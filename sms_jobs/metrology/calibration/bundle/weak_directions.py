"""Say in words what observations leave open: which parameters of which sensors trade against each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.metrology.geometry.lens import LENS

Ints = NDArray[np.signedinteger]

GROUPS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("direction", ("rx", "ry")),
    ("roll", ("rz",)),
    ("sideways position", ("tx", "ty")),
    ("distance", ("tz",)),
    *(
        (group, tuple(name for name, parameter in LENS.items() if parameter.group == group))
        for group in dict.fromkeys(parameter.group for parameter in LENS.values())
    ),
)
"""Parameters that mean the same to a person; (tx, ty, tz) is in the sensor's frame, so tz is the distance."""

_MOST_NAMED = 4
_SHARE = 0.1
_REGULAR = 1e-14


def weakest_direction(normal: Floats, sensors: Ints) -> Floats:
    """Return the direction of the sensors' parameters that is known worst.

    Parameters
    ----------
    normal
        (u, u) normal matrix of the free parameters; may be singular.
    sensors
        (k,) places among them of those of sensors.

    Returns
    -------
    (k,) the eigenvector of the largest eigenvalue of their covariance, each parameter in units of what it
    would be uncertain by if all others were known: the largest entries are what trades.
    """
    size = 1.0 / np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(normal * np.outer(size, size))
    inverse = (vectors / np.maximum(values, _REGULAR)) @ vectors.T
    return np.asarray(np.linalg.eigh(inverse[np.ix_(sensors, sensors)])[1][:, -1])


def described(direction: Floats, places: Ints, names: tuple[str, ...]) -> str:
    """Say which parameters of which sensors trade along a direction, and what would tell them apart.

    Parameters
    ----------
    direction
        (k,) from `weakest_direction`.
    places
        (k,) places of its parameters among all of the sensors.
    names
        Of the sensors.
    """
    full = np.zeros(PER_SENSOR * len(names))
    full[places] = direction
    energy: list[tuple[float, str, str]] = []
    for i, name in enumerate(names):
        own = full[PER_SENSOR * i : PER_SENSOR * (i + 1)]
        for group, members in GROUPS:
            at = [SENSOR_PARAMETERS.index(m) for m in members]
            energy.append((float(np.sum(own[at] ** 2)), group, name))
    energy.sort(key=lambda e: -e[0])
    strongest = [e for e in energy[:_MOST_NAMED] if e[0] > _SHARE * energy[0][0]]
    return f"{_sentence(strongest)}; {_advice({group for _, group, _ in strongest})}"


def _sentence(strongest: list[tuple[float, str, str]]) -> str:
    """Say "the focal length of P2 and its distance trade against each other"."""
    by_sensor: dict[str, list[str]] = {}
    for _, group, name in strongest:
        by_sensor.setdefault(name, []).append(group)
    parts = []
    for name, groups in by_sensor.items():
        parts.append(f"the {groups[0]} of {name}")
        parts += [f"its {group}" for group in groups[1:]]
    if len(parts) == 1:
        return f"{parts[0]} is left open"
    return f"{', '.join(parts[:-1])} and {parts[-1]} trade against each other"


def _advice(groups: set[str]) -> str:
    """Return what to do about a direction in which these groups trade."""
    if "focal length" in groups and groups & {"distance", "direction", "principal point"}:
        return "add poses at other depths, and tilted ones"
    if "distance" in groups:
        return "add poses at other depths, or an artefact of known length"
    if "distortion" in groups:
        return "add poses in the corners of the image"
    if "principal point" in groups:
        return "add tilted poses, and poses all over the image"
    return "add poses all over the volume"
