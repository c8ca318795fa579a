"""Calibrations with sensor parameters as the thesis writes them, in an XML file.

The file has the thesis's root <sms> with an element <calibration>; in it a list of sensors, each with its
chip (pixels, length_mm), principal point, focal length and distortion in mm, angles in degrees and pin-hole.
`metrology.geometry.thesis_parameters` has the equations.
"""

from __future__ import annotations

from datetime import datetime
from math import degrees, radians
from typing import Annotated, Any
from xml.sax.saxutils import escape

import numpy as np
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.interchange.calibration_formats import CalibrationFormat, Document
from sms_jobs.formats.interchange.found_sensors import LONGEST_SIDE_PX, FoundCalibration, FoundSensor
from sms_jobs.formats.interchange.xml_elements import Element
from sms_jobs.formats.interchange.xml_values import Places, value_of
from sms_jobs.metrology.geometry.thesis_parameters import (
    ImagePlane,
    Misfit,
    Pitch,
    ThesisParameters,
    sensor_from_thesis,
    thesis_from_sensor,
)
from sms_jobs.records.sensors import Box, Calibration
from sms_jobs.records.views import SENSOR_PATTERN, role_of

LARGEST_MISFIT_PX = 1.0
"""By how much the two distortion models may differ anywhere in an image before a conversion is refused."""

_Side = Annotated[int, Field(ge=1, le=LONGEST_SIDE_PX)]
_Length = Annotated[float, Field(gt=0.0)]
_Angle = Annotated[float, Field(ge=-360.0, le=360.0)]
_Vector = tuple[float, float, float]


class _Table(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)


class _Sensor(_Table):
    name: Annotated[str, Field(pattern=f"^{SENSOR_PATTERN}$")]
    pixels: tuple[_Side, _Side]
    length_mm: tuple[_Length, _Length]
    pixel_pitch: Pitch = "L/N"
    xi_h_mm: float
    eta_h_mm: float
    c_mm: _Length
    k1_per_mm2: float = 0.0
    k2_per_mm4: float = 0.0
    k3_per_mm6: float = 0.0
    omega_deg: _Angle
    phi_deg: _Angle
    kappa_deg: _Angle
    pin_hole_mm: _Vector

    def found(self, source: str) -> tuple[FoundSensor, str]:
        """Return the sensor in this program's camera model, and what its conversion cost."""
        plane = ImagePlane(self.length_mm, self.pixels, self.pixel_pitch)
        parameters = ThesisParameters(
            self.xi_h_mm,
            self.eta_h_mm,
            self.c_mm,
            self.k1_per_mm2,
            self.k2_per_mm4,
            self.k3_per_mm6,
            radians(self.omega_deg),
            radians(self.phi_deg),
            radians(self.kappa_deg),
            self.pin_hole_mm,
        )
        try:
            with np.errstate(over="raise", invalid="raise", divide="raise"):
                intrinsics, pose, misfit = sensor_from_thesis(parameters, plane)
        except (FloatingPointError, np.linalg.LinAlgError):
            raise ConfigurationError(
                f"the parameters of {self.name} in {source} cannot be those of a sensor: its distortion goes "
                "beyond all numbers"
            ) from None
        role = role_of(self.name)
        return FoundSensor(role, intrinsics, pose, self.name, self.pixels), _cost(self.name, misfit, source)


class _Volume(_Table):
    low_mm: _Vector
    high_mm: _Vector


class _Calibration(_Table):
    sensors: tuple[_Sensor, ...]
    rig: str | None = None
    valid_from: AwareDatetime | None = None
    origin: str | None = None
    volume: _Volume | None = None


def _fits(document: Document) -> bool:
    return document.root is not None and document.root.name == "sms"


def find_thesis_calibration(document: Document) -> FoundCalibration:
    """Return the sensors that the element <calibration> of a file describes.

    Raises
    ------
    ConfigurationError
        It is missing or says what cannot be, or the distortion of a sensor cannot be carried over; the
        message names line and element.
    """
    root, source = document.root, document.source
    children: list[Element] = [] if root is None else root.children
    section = next((child for child in children if child.name == "calibration"), None)
    if section is None:
        raise ConfigurationError(
            f"{source} has no element <calibration> inside of a root <sms>; 'sms calibration export NUMBER "
            "--as thesis-xml' writes such a file"
        )
    places = Places(source)
    content = value_of(section, places, "sms/calibration", ())
    try:
        table = _Calibration.model_validate(_tuples(content))
    except ValidationError as error:
        first, *more = error.errors(include_url=False)
        rest = f" (and {len(more)} more)" if more else ""
        missing = f"{first['loc'][-1]} is missing" if first["type"] == "missing" else ""
        raise ConfigurationError(
            f"{places.at(first['loc'])}: {missing or _plain(first['msg'], first['input'])}{rest}"
        ) from None
    found = [sensor.found(source) for sensor in table.sensors]
    volume = None if table.volume is None else Box(table.volume.low_mm, table.volume.high_mm)
    return FoundCalibration(
        sensors=tuple(sensor for sensor, _ in found),
        in_millimetres=True,
        remarks=tuple(remark for _, remark in found),
        rig=table.rig,
        volume=volume,
        valid_from=table.valid_from,
        origin=table.origin,
    )


def thesis_text(calibration: Calibration, pixel_pitch_mm: float) -> tuple[str, tuple[str, ...]]:
    """Return a calibration as the thesis writes it, and what the conversion cost each sensor.

    Raises
    ------
    ConfigurationError
        The distortion of a sensor cannot be carried over.
    """
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        "<sms>",
        "  <calibration>",
        _leaf(4, "rig", calibration.rig.name),
        _leaf(4, "valid_from", calibration.valid_from),
        _leaf(4, "origin", calibration.origin),
        "    <volume>",
        _leaf(6, "low_mm", calibration.volume.low),
        _leaf(6, "high_mm", calibration.volume.high),
        "    </volume>",
        '    <sensors type="list">',
    ]
    remarks = []
    for sensor in calibration.rig.sensors:
        p, plane, misfit = thesis_from_sensor(
            sensor.intrinsics, sensor.pose, (sensor.columns, sensor.rows), pixel_pitch_mm
        )
        remarks.append(_cost(sensor.name, misfit, f"calibration of {calibration.rig.name}"))
        values: dict[str, Any] = {
            "name": sensor.name,
            "pixels": plane.pixels,
            "length_mm": plane.length_mm,
            "pixel_pitch": plane.pitch,
            "xi_h_mm": p.xi_h,
            "eta_h_mm": p.eta_h,
            "c_mm": p.c,
            "k1_per_mm2": p.k1,
            "k2_per_mm4": p.k2,
            "k3_per_mm6": p.k3,
            "omega_deg": degrees(p.omega),
            "phi_deg": degrees(p.phi),
            "kappa_deg": degrees(p.kappa),
            "pin_hole_mm": p.pin_hole,
        }
        lines += [
            "      <sensor>",
            *(_leaf(8, key, value) for key, value in values.items()),
            "      </sensor>",
        ]
    lines += ["    </sensors>", "  </calibration>", "</sms>", ""]
    return "\n".join(lines), tuple(remarks)


def _cost(name: str, misfit: Misfit, source: str) -> str:
    if not misfit.largest_px <= LARGEST_MISFIT_PX:
        raise ConfigurationError(
            f"the distortion of {name} in {source} cannot be carried over: the two models differ by up to "
            f"{misfit.largest_px:.3g} px, allowed are {LARGEST_MISFIT_PX:g} px"
        )
    return f"{name}: distortion carried over within {misfit.largest_px:.2g} px ({misfit.rms_px:.2g} px rms)"


def _leaf(indent: int, name: str, value: Any) -> str:
    """Return an element with one value, and the type that the thesis wants said."""
    if isinstance(value, tuple):
        kind, text = "list", " ".join(map(repr, value))
    elif isinstance(value, datetime):
        kind, text = "time", value.isoformat()
    elif isinstance(value, float):
        kind, text = "float", repr(value)
    else:
        kind, text = "text", escape(str(value))
    return f'{" " * indent}<{name} type="{kind}">{text}</{name}>'


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(v) for key, v in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _plain(message: str, value: Any) -> str:
    shown = f", not {value!r}" if isinstance(value, str | int | float) else ""
    return message.replace("Input should", "should").replace("Extra inputs are", "is") + shown


FORMAT = CalibrationFormat("thesis", _fits, find_thesis_calibration)
