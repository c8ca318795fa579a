"""MatchID's calibration file, .caldat: a name and a number in each line, as in Cam0_Fx [pixels];6651.97.

Cx, Cy, Fx, Fy and the skew Fs are in px; Kappa 1 to 3 are of r^2, r^4, r^6 and P1, P2 as OpenCV has them,
from the ideal point to the one that is seen. The rotation Rz(Psi) Ry(Phi) Rx(Theta), in degrees, and the
translation in mm lead from the first camera to the second. pyvale writes the same names, as YAML too.
"""

from __future__ import annotations

import re

import numpy as np

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.interchange.calibration_formats import CalibrationFormat, Document
from sms_jobs.formats.interchange.found_sensors import (
    FoundCalibration,
    FoundSensor,
    cardan_rotation,
    intrinsics_from,
    number,
    pose_from,
)
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.records.scene import AT_ORIGIN
from sms_jobs.records.views import Role

_FIRST = re.compile(r"^\s*['\"]?cam\d+_fx\b", re.IGNORECASE | re.MULTILINE)
_LINE = re.compile(
    r"['\"]?(?P<name>[A-Za-z][\w ]{0,40}?)\s*(?:\[(?P<unit>[^\]]{0,20})\])?['\"]?\s*[;:,=]\s*(?P<value>.*)"
)
_OF_A_CAMERA = re.compile(r"cam(\d{1,3})_(\w+)")
_INNER = {"fx", "fy", "cx", "cy", "fs", "kappa1", "kappa2", "kappa3", "p1", "p2"}
_OUTER = ("theta", "phi", "psi", "tx", "ty", "tz")
_UNITS = {
    **dict.fromkeys(("fx", "fy", "cx", "cy", "fs"), ("pixels", "pixel", "px")),
    **dict.fromkeys(("theta", "phi", "psi"), ("deg", "degrees", "°")),
    **dict.fromkeys(("tx", "ty", "tz"), ("mm",)),
}


def _fits(document: Document) -> bool:
    return document.root is None and _FIRST.search(document.text) is not None


def find_matchid_calibration(document: Document) -> FoundCalibration:
    """Return the two cameras that a calibration file of MatchID describes.

    Raises
    ------
    ConfigurationError
        A line is none of its lines, a number is missing, or there are not two cameras.
    """
    source = document.source
    found = _numbers(document)
    cameras = sorted({int(said[1]) for name in found if (said := _OF_A_CAMERA.fullmatch(name))})
    if len(cameras) != 2:
        raise ConfigurationError(
            f"{source} has the cameras {', '.join(map(str, cameras))}; a calibration of MatchID has two"
        )
    missing = [name for name in _OUTER if name not in found]
    if missing:
        raise ConfigurationError(f"{missing[0].capitalize()} is missing in {source}")
    theta, phi, psi, *translation = (found[name] for name in _OUTER)
    second = pose_from(cardan_rotation(theta, phi, psi), np.array(translation), source)
    poses: tuple[Pose, ...] = (AT_ORIGIN, second)
    sensors = tuple(
        FoundSensor(Role.CAMERA, _intrinsics(found, camera, source), pose)
        for camera, pose in zip(cameras, poses, strict=True)
    )
    known = {f"cam{camera}_{name}" for camera in cameras for name in _INNER} | set(_OUTER)
    unused = [name for name in found if name not in known]
    remarks = (f"not taken over from {source}: {', '.join(unused)}",) if unused else ()
    return FoundCalibration(sensors, in_millimetres=True, remarks=remarks)


def _intrinsics(found: dict[str, float], camera: int, source: str) -> Intrinsics:
    where = f"Cam{camera} of {source}"
    for name in ("Fx", "Fy", "Cx", "Cy"):
        if f"cam{camera}_{name.lower()}" not in found:
            raise ConfigurationError(f"{name} of {where} is missing")
    own = {name: found.get(f"cam{camera}_{name}", 0.0) for name in _INNER}
    matrix = np.array([[own["fx"], own["fs"], own["cx"]], [0.0, own["fy"], own["cy"]], [0.0, 0.0, 1.0]])
    coefficients = [own[name] for name in ("kappa1", "kappa2", "p1", "p2", "kappa3")]
    return intrinsics_from(matrix, np.array(coefficients), where)


def _numbers(document: Document) -> dict[str, float]:
    """Return the numbers of a file, by names in small letters without spaces and units."""
    found: dict[str, float] = {}
    for count, line in enumerate(document.text.splitlines(), start=1):
        text = line.strip()
        if not text:
            continue
        where = f"{document.source}, line {count}"
        said = _LINE.fullmatch(text)
        if said is None:
            raise ConfigurationError(f"{where}: '{text[:40]}' is no line with a name and a number")
        name = said["name"].lower().replace(" ", "")
        units = _UNITS.get(name.rsplit("_", 1)[-1], ())
        if said["unit"] is not None and units and said["unit"].strip().lower() not in units:
            raise ConfigurationError(f"{where}: {said['name']} should be in {units[0]}, not {said['unit']}")
        if name in found:
            raise ConfigurationError(f"{where}: {said['name']} is given twice in one file")
        found[name] = number(said["value"], f"{said['name']} in line {count} of {document.source}")
    return found


FORMAT = CalibrationFormat("MatchID", _fits, find_matchid_calibration)
