"""The calibration in a project of VIC-3D: XML with an element <calibration> of cameras.

The text of a camera is cx, cy, fx, fy, the skew, all in px, and k1, k2, k3 of r^2, r^4, r^6, which lead from
the ideal point to the one that is seen; its <orientation> is alpha, beta, gamma in degrees and a translation.
The rotation Rz(gamma) Ry(beta) Rx(alpha) and the translation bring the world into the camera.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.interchange.calibration_formats import CalibrationFormat, Document
from sms_jobs.formats.interchange.found_sensors import (
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
from sms_jobs.records.views import Role

_INNER = "cx, cy, fx, fy, skew, k1, k2, k3"
_OUTER = "alpha, beta, gamma, tx, ty, tz"


def _section(document: Document) -> Element | None:
    root = document.root
    if root is None or root.name == "calibration":
        return root
    return next((child for child in root.children if child.name == "calibration"), None)


def _fits(document: Document) -> bool:
    section = _section(document)
    return section is not None and any(child.name == "camera" for child in section.children)


def find_vic3d_calibration(document: Document) -> FoundCalibration:
    """Return the cameras that a project of VIC-3D describes.

    Raises
    ------
    ConfigurationError
        It says what cannot be, or is of another version.
    """
    section = _section(document)
    assert section is not None
    source = document.source
    cameras = [child for child in section.children if child.name == "camera"]
    if len(cameras) < 2:
        raise ConfigurationError(f"{source} has one camera; a calibration of VIC-3D has two or more")
    numbers = [camera.attributes.get("id", "") for camera in cameras]
    if numbers != [str(k) for k in range(len(cameras))]:
        raise ConfigurationError(
            f"the cameras of {source} have the ids {', '.join(numbers)}, not 0, 1, ... in this order"
        )
    assert document.root is not None
    size, remarks = _size(document.root, source)
    found = tuple(_camera(camera, size, source) for camera in cameras)
    return FoundCalibration(found, in_millimetres=False, remarks=remarks)


def _camera(camera: Element, size: tuple[int, int] | None, source: str) -> FoundSensor:
    where = f"camera {camera.attributes['id']} of {source}"
    others = [child.name for child in camera.children if child.name != "orientation"]
    if others:
        raise ConfigurationError(
            f"{where}, line {camera.line}, has <{others[0]}>, as other versions of VIC-3D write it: what its "
            "numbers mean is not known here; enter them as a file of OpenCV"
        )
    if len(camera.children) != 1:
        raise ConfigurationError(
            f"{where}, line {camera.line}, has {len(camera.children)} elements <orientation>, not one"
        )
    cx, cy, fx, fy, skew, k1, k2, k3 = number_list(camera.text, 8, f"the text of {where} ({_INNER})")
    outer = number_list(camera.children[0].text, 6, f"<orientation> of {where} ({_OUTER})")
    matrix = np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    intrinsics = intrinsics_from(matrix, np.array([k1, k2, 0.0, 0.0, k3]), where)
    pose = pose_from(cardan_rotation(*outer[:3].tolist()), outer[3:], where)
    return FoundSensor(Role.CAMERA, intrinsics, pose, size=size)


def _size(root: Element, source: str) -> tuple[tuple[int, int] | None, tuple[str, ...]]:
    """Return the size of the image that areas of interest were drawn into, and the remark that says so."""
    sizes = {
        (mask.attributes["width"], mask.attributes["height"])
        for mask in _below(root)
        if mask.name == "polygonmask" and {"width", "height"} <= mask.attributes.keys()
    }
    if len(sizes) != 1:
        return None, ()
    ((width, height),) = sizes
    where = f"<polygonmask> of {source}"
    size = image_size(number(width, where), number(height, where), where)
    return size, (f"image size of all cameras from the area of interest: {size[0]} x {size[1]} px",)


def _below(element: Element) -> Iterator[Element]:
    for child in element.children:
        yield child
        yield from _below(child)


FORMAT = CalibrationFormat("VIC-3D", _fits, find_vic3d_calibration)
