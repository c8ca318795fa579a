"""Calibrations in OpenCV's file storage: this program's own layout for any rig, and what others write.

The own layout has a table for every sensor with the names that OpenCV's own programs use - image_width,
image_height, camera_matrix, distortion_coefficients - and R and T, which bring the world, in mm, into the
sensor: x = R X + T; a fisheye has fisheye_model: 1 besides, as OpenCV's sample writes it. Of other programs,
those layouts are read that `_LAYOUTS` names; there the world is the frame of the first sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np

from sms_jobs.errors import ConfigurationError, InvalidInput, OtherFormat
from sms_jobs.formats.interchange.found_sensors import (
    CAMERA_MODEL,
    FoundCalibration,
    FoundSensor,
    image_size,
    intrinsics_from,
    numbers,
    opencv_coefficients,
    pose_from,
)
from sms_jobs.formats.interchange.opencv_text import Table
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.records.scene import AT_ORIGIN
from sms_jobs.records.sensors import Box, Calibration
from sms_jobs.records.times import parsed_time
from sms_jobs.records.views import Role, role_of

Dialect: TypeAlias = Literal["yml", "xml", "json"]

_VERSION_KEY = "sms_calibration"
_VERSION = 1


@dataclass(frozen=True)
class _Names:
    """The names under which a program writes a sensor; sizes are (width, height) or one name for both."""

    matrix: str
    distortion: str
    role: Role
    sizes: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True)
class _Layout:
    """The names under which a program writes its sensors, and the way from the first to the second."""

    sensors: tuple[_Names, ...]
    rotation: tuple[str, ...] = ()
    translation: tuple[str, ...] = ()


_SIZES = (
    ("image_width", "image_height"),
    ("frameWidth", "frameHeight"),
    ("ImageWidth", "ImageHeight"),
    ("frame_width", "frame_height"),
    ("image_Width", "image_Height"),
    ("image_size",),
    ("imageSize",),
    ("S",),
    ("size",),
    ("cam_size",),
)
_SCREENS = (("screenResX", "screenResY"), ("proj_width", "proj_height"), ("projector_size",), ("pro_size",))


def _camera(matrix: str, distortion: str) -> _Names:
    return _Names(matrix, distortion, Role.CAMERA, _SIZES)


def _projector(matrix: str, distortion: str) -> _Names:
    return _Names(matrix, distortion, Role.PROJECTOR, _SCREENS)


_R = ("R", "Rot", "rotation", "rotation_matrix")
_T = ("T", "Trans", "translation", "translation_vector")
_MATRICES = ("M", "K", "cameraMatrix", "camera_matrix", "CameraMatrix", "mtx")
_DISTORTIONS = ("D", "distCoeffs", "distortion_coefficients", "dist_coeffs", "DistCoeffs", "dist")
_SIDES = (
    ("1", "2"),
    ("_1", "_2"),
    ("0", "1"),
    ("_0", "_1"),
    ("_left", "_right"),
    ("Left", "Right"),
    ("L", "R"),
    ("_l", "_r"),
)
_LAYOUTS = (
    _Layout((_camera("M1", "D1"), _projector("M4", "D4")), ("Rlp",), ("Tlp",)),  # SLMaster
    _Layout((_camera("Kc", "kc"), _projector("Kp", "kp")), ("Rp",), ("Tp",)),  # SLStudio
    _Layout((_camera("cam_K", "cam_kc"), _projector("proj_K", "proj_kc")), _R, _T),  # Moreno and Taubin
    _Layout((_camera("cam_int", "cam_dist"), _projector("proj_int", "proj_dist")), (*_R, "roration"), _T),
    *(  # OpenCV's sample stereo_calib has M1 D1 and M2 D2
        _Layout((_camera(f"{k}{one}", f"{d}{one}"), _camera(f"{k}{two}", f"{d}{two}")), _R, _T)
        for k in _MATRICES
        for d in _DISTORTIONS
        for one, two in _SIDES
    ),
    *(
        _Layout((_camera(matrix, distortion),), _R, _T)
        for matrix, distortion in (
            ("camera_matrix", "distortion_coefficients"),  # OpenCV's sample calibration, ROS
            ("camera_matrix", "dist_coeffs"),
            ("camera_matrix", "dist_coeff"),
            ("Camera_Matrix", "Distortion_Coefficients"),
            ("CameraMatrix", "DistortionCoefficients"),
            ("cameraMatrix", "distCoeffs"),
            ("K", "D"),
        )
    ),
)
_FISHEYES = {"equidistant", "fisheye", "kannala_brandt", "kannala_brandt4", "opencv_fisheye"}
_MODEL_KEYS = ("distortion_model", "camera_model")
_MODELS = _FISHEYES | {
    "plumb_bob",
    "rational_polynomial",
    "radtan",
    "brown",
    "opencv",
    "pinhole",
    "perspective",
}


def find_opencv_calibration(table: Table, source: str) -> FoundCalibration:
    """Return the sensors that a file of OpenCV describes; `source` names it in messages.

    Raises
    ------
    ConfigurationError
        It describes none, or what the camera model here does not hold.
    OtherFormat
        It was written by a newer version of this program.
    """
    return _own(table, source) if _VERSION_KEY in table else _foreign(table, source)


def _own(table: Table, source: str) -> FoundCalibration:
    version = table[_VERSION_KEY]
    if not isinstance(version, int) or version < 1:
        raise ConfigurationError(f"{_VERSION_KEY} of {source} should be a version such as 1, not {version!r}")
    if version > _VERSION:
        raise OtherFormat(
            f"{source} has the format {version}, this program reads up to {_VERSION}: update this program"
        )
    names = _needed(table, "sensors", source)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ConfigurationError(f"sensors of {source} should be a list of names, not {names!r}")
    low, high = (
        numbers(_needed(table, key, source), f"{key} of {source}")
        for key in ("volume_low_mm", "volume_high_mm")
    )
    if low.shape != (3,) or high.shape != (3,):
        raise ConfigurationError(f"volume_low_mm and volume_high_mm of {source} should be three numbers each")
    return FoundCalibration(
        sensors=tuple(_own_sensor(table, name, source) for name in names),
        in_millimetres=True,
        rig=_text(table, "rig", source),
        volume=Box(
            (low[0].item(), low[1].item(), low[2].item()), (high[0].item(), high[1].item(), high[2].item())
        ),
        valid_from=_time(_text(table, "valid_from", source), source),
        origin=_text(table, "origin", source),
    )


def _own_sensor(table: Table, name: str, source: str) -> FoundSensor:
    found = _needed(table, name, source)
    where = f"{name} in {source}"
    if not isinstance(found, dict):
        raise ConfigurationError(f"{where} should be a table, not {found!r}")
    values = [_needed(found, key, where) for key in ("camera_matrix", "distortion_coefficients", "R", "T")]
    matrix, coefficients, rotation, translation = (numbers(v, where) for v in values)
    intrinsics = intrinsics_from(matrix, coefficients, where, fisheye=found.get("fisheye_model", 0) != 0)
    if "skew" in found:
        # The matrix has it in px, which is rounded.
        skew = float(numbers(found["skew"], f"skew of {where}").ravel()[0])
        if not np.isclose(skew, intrinsics.skew, rtol=1e-9, atol=0.0):
            raise ConfigurationError(
                f"{where} says two skews: {skew:g} of fx, and {intrinsics.skew:g} of fx in camera_matrix"
            )
        intrinsics = replace(intrinsics, skew=skew)
    return FoundSensor(
        role=role_of(name),
        intrinsics=intrinsics,
        pose=pose_from(rotation, translation, where),
        name=name,
        size=image_size(_needed(found, "image_width", where), _needed(found, "image_height", where), where),
    )


def _foreign(table: Table, source: str) -> FoundCalibration:
    fisheye = _is_fisheye(table, source)
    layout = next((one for one in _LAYOUTS if _fits(one, table)), None)
    if layout is None:
        known = "; ".join(
            ", ".join(f"{n.matrix} {n.distortion}" for n in one.sensors) for one in _LAYOUTS[:5]
        )
        raise ConfigurationError(
            f"{source} has no camera matrices and distortions under names that are known here: it has "
            f"{', '.join(list(table)[:12]) or 'nothing'}; known are {known}; camera_matrix "
            "distortion_coefficients; and the like"
        )
    used: set[str] = set()
    poses = [AT_ORIGIN] if len(layout.sensors) == 2 else []
    poses.append(_second_pose(layout, table, source, used))
    sensors = tuple(
        _foreign_sensor(names, pose, table, source, used, fisheye)
        for names, pose in zip(layout.sensors, poses, strict=True)
    )
    unused = [name for name in table if name not in {*used, *_MODEL_KEYS, "fisheye_model"}]
    remarks = (f"not taken over from {source}: {', '.join(unused)}",) if unused else ()
    return FoundCalibration(sensors, in_millimetres=False, remarks=remarks)


def _foreign_sensor(
    names: _Names, pose: Pose, table: Table, source: str, used: set[str], fisheye: bool
) -> FoundSensor:
    of_matrix = f"{names.matrix} in {source}"
    matrix = numbers(table[names.matrix], of_matrix)
    coefficients = numbers(table[names.distortion], f"{names.distortion} in {source}")
    used |= {names.matrix, names.distortion}
    size = None
    for keys in names.sizes:
        if not all(key in table for key in keys):
            continue
        where = f"{' and '.join(keys)} in {source}"
        sides = numbers([table[k] for k in keys] if len(keys) == 2 else table[keys[0]], where).ravel()
        if sides.size != 2:
            raise ConfigurationError(f"{where} should be a width and a height")
        size = image_size(sides[0], sides[1], where)
        used |= set(keys)
        break
    intrinsics = intrinsics_from(matrix, coefficients, of_matrix, fisheye=fisheye)
    return FoundSensor(names.role, intrinsics, pose, size=size)


def _second_pose(layout: _Layout, table: Table, source: str, used: set[str]) -> Pose:
    """Return the way from the first sensor to the second, or of the world to a sensor that is alone."""
    rotation = next((name for name in layout.rotation if name in table), None)
    translation = next((name for name in layout.translation if name in table), None)
    if rotation is None or translation is None:
        if len(layout.sensors) == 1 and rotation is None and translation is None:
            return AT_ORIGIN
        missing = layout.rotation[0] if rotation is None else layout.translation[0]
        raise ConfigurationError(
            f"{source} does not give the poses of the sensors: {missing} is missing; if it is in a second "
            f"file, such as extrinsics.yml, give both files"
        )
    used |= {rotation, translation}
    return pose_from(
        numbers(table[rotation], f"{rotation} in {source}"),
        numbers(table[translation], f"{translation} in {source}"),
        f"{rotation}, {translation} in {source}",
    )


def _fits(layout: _Layout, table: Table) -> bool:
    return all(names.matrix in table and names.distortion in table for names in layout.sensors)


def _is_fisheye(table: Table, source: str) -> bool:
    """Say whether a file is of fisheyes; refuse cameras whose coefficients mean something else yet."""
    models = [table[key] for key in _MODEL_KEYS if isinstance(table.get(key), str)]
    for model in models:
        if model.lower() not in _MODELS:
            raise ConfigurationError(
                f"{source} says the model '{model}', but the camera model here is {CAMERA_MODEL}"
            )
    if any(key == "xi" or key.startswith("xi_") for key in table):
        raise ConfigurationError(
            f"{source} describes an omnidirectional camera, but the camera model here is {CAMERA_MODEL}"
        )
    return table.get("fisheye_model", 0) != 0 or any(model.lower() in _FISHEYES for model in models)


def _needed(table: Table, key: str, where: str) -> Any:
    if key not in table:
        raise ConfigurationError(f"{key} is missing in {where}")
    return table[key]


def _text(table: Table, key: str, source: str) -> str:
    value = _needed(table, key, source)
    if not isinstance(value, str):
        raise ConfigurationError(f"{key} of {source} should be text in quotes, not {value!r}")
    if "\0" in value or any("\ud800" <= letter <= "\udfff" for letter in value):
        raise ConfigurationError(f"{key} of {source} has letters that no text has: {value[:40]!a}")
    return value


def _time(text: str, source: str) -> datetime:
    try:
        return parsed_time(text, f"valid_from of {source}")
    except InvalidInput as error:
        raise ConfigurationError(str(error)) from None


def opencv_text(calibration: Calibration, dialect: Dialect) -> str:
    """Return a calibration as OpenCV itself writes it; every number comes back bit for bit."""
    storage = cv2.FileStorage(f".{dialect}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write(_VERSION_KEY, _VERSION)
    storage.write("rig", calibration.rig.name)
    storage.write("valid_from", calibration.valid_from.isoformat())
    storage.write("origin", calibration.origin)
    _write_list(storage, "volume_low_mm", calibration.volume.low)
    _write_list(storage, "volume_high_mm", calibration.volume.high)
    _write_list(storage, "sensors", [s.name for s in calibration.rig.sensors])
    for sensor in calibration.rig.sensors:
        storage.startWriteStruct(sensor.name, cv2.FileNode_MAP)
        storage.write("role", sensor.role.value)
        storage.write("image_width", sensor.columns)
        storage.write("image_height", sensor.rows)
        storage.write("camera_matrix", sensor.intrinsics.matrix())
        storage.write("distortion_coefficients", opencv_coefficients(sensor.intrinsics)[None])
        if sensor.intrinsics.fisheye:
            storage.write("fisheye_model", 1)
        storage.write("skew", sensor.intrinsics.skew)
        storage.write("R", sensor.pose.matrix())
        storage.write("T", np.array(sensor.pose.translation)[:, None])
        storage.endWriteStruct()
    return str(storage.releaseAndGetString())


def _write_list(storage: cv2.FileStorage, name: str, values: Any) -> None:
    storage.startWriteStruct(name, cv2.FileNode_SEQ | cv2.FileNode_FLOW)
    for value in values:
        storage.write("", value)
    storage.endWriteStruct()
