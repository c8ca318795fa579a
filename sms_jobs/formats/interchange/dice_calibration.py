"""DICe's camera system file: XML with a list of parameters for every camera.

A camera has CX, CY, FX, FY in px, the coefficients of the lens model that LENS_DISTORTION_MODEL names, its
IMAGE_HEIGHT_WIDTH, and where it stands: TX, TY, TZ and a rotation matrix, or ALPHA, BETA, GAMMA in degrees,
bring the world into the camera. With extrinsics_relative_camera_to_camera the second camera is given by the
way from the first to it. What is zero may be left out.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.interchange.calibration_formats import CalibrationFormat, Document
from sms_jobs.formats.interchange.found_sensors import (
    CAMERA_MODEL,
    FoundCalibration,
    FoundSensor,
    cardan_rotation,
    image_size,
    intrinsics_from,
    number,
    number_list,
    pose_from,
)
from sms_jobs.formats.interchange.xml_elements import Element
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import compose
from sms_jobs.records.views import Role

_KIND = "DICe_xml_camera_system_file"
_ANGLES = ("ALPHA", "BETA", "GAMMA")
_ROTATION = "rotation_3x3_matrix"
_OPENCV = ("K1", "K2", "P1", "P2", "K3", "K4", "K5", "K6", "S1", "S2", "S3", "S4", "T1", "T2")
_RADIAL = ("K1", "K2", "K3")
_TAKEN = {
    "NONE": (),
    "NO_LENS_DISTORTION": (),
    "OPENCV_DIS": _OPENCV,
    "OPENCV_LENS_DISTORTION": _OPENCV,
    "VIC3D_DIS": (*_RADIAL, "FS"),
    "VIC3D_LENS_DISTORTION": (*_RADIAL, "FS"),
    "K1R3_K2R5_K3R7": _RADIAL,
}
"""What a camera's lens model takes of it, for the models that ours can say: displacements by odd powers of
the radius, from the third on, are OpenCV's radial terms, and so are VIC-3D's."""

_SAID = {"TX", "TY", "TZ", "CX", "CY", "FX", "FY", "LENS_DISTORTION_MODEL", "IMAGE_HEIGHT_WIDTH"}
_WITHOUT_MEANING = {"CAMERA_ID", "PIXEL_DEPTH", "LENS", "COMMENTS", _ROTATION, *_ANGLES}
_OF_THE_SYSTEM = {"xml_file_format", "system_type_3D", "extrinsics_relative_camera_to_camera"}

_List: TypeAlias = dict[str, Element]


def _fits(document: Document) -> bool:
    return document.root is not None and document.root.name == "ParameterList"


def find_dice_calibration(document: Document) -> FoundCalibration:
    """Return the cameras that a camera system file of DICe describes.

    Raises
    ------
    ConfigurationError
        It is another file of DICe, or says what cannot be or what the camera model here does not hold.
    """
    assert document.root is not None
    source = document.source
    system = _parameters(document.root, source)
    if "xml_file_format" not in system or _value(system, "xml_file_format", source) != _KIND:
        raise ConfigurationError(
            f"{source} is a parameter list, but no camera system file of DICe: its xml_file_format is not "
            f"{_KIND}"
        )
    names = [name for name in system if name.startswith("CAMERA ")]
    if names != [f"CAMERA {k}" for k in range(len(names))] or len(names) < 2:
        raise ConfigurationError(
            f"{source} has {', '.join(names) or 'no camera'}; a camera system has two cameras or more, "
            "counted from CAMERA 0"
        )
    remarks: list[str] = []
    found = [_camera(system[name], f"{name} of {source}", remarks) for name in names]
    if _relative(system, source):
        if len(found) != 2:
            raise ConfigurationError(
                f"{source} says extrinsics_relative_camera_to_camera of {len(found)} cameras, which only two "
                "can have"
            )
        first, second = found
        pose = compose(second.pose, first.pose)
        found = [first, FoundSensor(second.role, second.intrinsics, pose, size=second.size)]
    unused = [name for name in system if name not in _OF_THE_SYSTEM and name not in names]
    if unused:
        remarks.append(f"not taken over from {source}: {', '.join(unused)}")
    return FoundCalibration(tuple(found), in_millimetres=False, remarks=tuple(remarks))


def _camera(element: Element, where: str, remarks: list[str]) -> FoundSensor:
    found = _parameters(element, where)
    model = _value(found, "LENS_DISTORTION_MODEL", where) if "LENS_DISTORTION_MODEL" in found else "NONE"
    if model not in _TAKEN:
        raise ConfigurationError(
            f"LENS_DISTORTION_MODEL of {where} is '{model}', but the camera model here is {CAMERA_MODEL}, "
            f"which holds {', '.join(_TAKEN)}: calibrate again with one of these"
        )
    taken = _TAKEN[model]
    left = [
        name
        for name in found
        if name not in {*_SAID, *_WITHOUT_MEANING, *taken}
        and (name not in {*_OPENCV, "FS"} or _number(found, name, where) != 0.0)
    ]
    if left:
        remarks.append(f"not taken over from {where}, since {model} does not use it: {', '.join(left)}")
    return FoundSensor(
        Role.CAMERA, _intrinsics(found, taken, where), _pose(found, where), size=_size(found, where)
    )


def _intrinsics(found: _List, taken: tuple[str, ...], where: str) -> Intrinsics:
    for name in ("CX", "CY", "FX", "FY"):
        if name not in found:
            raise ConfigurationError(f"{name} is missing in {where}")
    fx, fy, cx, cy, fs = (_number(found, name, where) for name in ("FX", "FY", "CX", "CY", "FS"))
    matrix = np.array([[fx, fs if "FS" in taken else 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    coefficients = [_number(found, name, where) if name in taken else 0.0 for name in _OPENCV]
    return intrinsics_from(matrix, np.array(coefficients), where)


def _pose(found: _List, where: str) -> Pose:
    angles = [name for name in _ANGLES if name in found]
    if _ROTATION in found and angles:
        raise ConfigurationError(f"{where} has both {_ROTATION} and {angles[0]}: remove one of them")
    if _ROTATION in found:
        rows = _parameters(found[_ROTATION], where)
        missing = [name for name in ("ROW 0", "ROW 1", "ROW 2") if name not in rows]
        if missing:
            raise ConfigurationError(f"{missing[0]} of {_ROTATION} is missing in {where}")
        rotation = np.array([_numbers(rows, f"ROW {k}", 3, where) for k in range(3)])
    else:
        rotation = cardan_rotation(*(_number(found, name, where) for name in _ANGLES))
    return pose_from(rotation, np.array([_number(found, name, where) for name in ("TX", "TY", "TZ")]), where)


def _size(found: _List, where: str) -> tuple[int, int] | None:
    if "IMAGE_HEIGHT_WIDTH" not in found:
        return None
    height, width = _numbers(found, "IMAGE_HEIGHT_WIDTH", 2, where)
    return image_size(float(width), float(height), f"IMAGE_HEIGHT_WIDTH of {where}")


def _relative(system: _List, source: str) -> bool:
    key = "extrinsics_relative_camera_to_camera"
    said = _value(system, key, source).lower() if key in system else "false"
    if said not in ("true", "false", "1", "0"):
        raise ConfigurationError(f"{key} of {source} should be true or false, not '{said[:40]}'")
    return said in ("true", "1")


def _parameters(element: Element, where: str) -> _List:
    """Return the parameters and lists in a list, by name."""
    found: _List = {}
    for child in element.children:
        name = child.attributes.get("name")
        if child.name not in ("Parameter", "ParameterList") or name is None:
            raise ConfigurationError(
                f"{where}, line {child.line}: <{child.name}> is no Parameter or ParameterList with a name"
            )
        if name in found:
            raise ConfigurationError(f"{where}, line {child.line}: '{name}' stands twice in one list")
        found[name] = child
    return found


def _value(found: _List, name: str, where: str) -> str:
    value = found[name].attributes.get("value")
    if value is None:
        raise ConfigurationError(f"{name} of {where}, line {found[name].line}, has no value")
    return value.strip()


def _number(found: _List, name: str, where: str) -> float:
    """Return a number; 0 for what is left out."""
    return number(_value(found, name, where), f"{name} of {where}") if name in found else 0.0


def _numbers(found: _List, name: str, count: int, where: str) -> Floats:
    text = _value(found, name, where)
    return number_list(text.strip("{} ").replace(",", " "), count, f"{name} of {where}")


FORMAT = CalibrationFormat("DICe", _fits, find_dice_calibration)
