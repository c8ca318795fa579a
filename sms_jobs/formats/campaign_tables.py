"""The tables of a campaign file: what keys they have, what values are possible, which records they make.

Keys are the names of the records' fields, with angles in degrees (`..._deg`) instead of radians.
"""

from __future__ import annotations

import re
from dataclasses import MISSING, dataclass, fields
from datetime import UTC, datetime
from functools import cache
from math import radians
from typing import Annotated, Any, TypeAlias, Union, get_type_hints

import numpy as np
from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetPydanticSchema,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError, core_schema
from scipy.spatial.transform import Rotation

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import Intrinsics, Pose
from sms_jobs.metrology.phase.sequences import named_sequence
from sms_jobs.records import scene as scenes
from sms_jobs.records.artefacts import BallBar, Chessboard, CircleBoard
from sms_jobs.records.campaign import Campaign, LoadState, ParameterValue, Specimen
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import CameraResponse, Gloss, ProjectorResponse, Scene, Speckle
from sms_jobs.records.sensors import Box, Calibration, Rig, Role, Sensor, split_pair

LONGEST_SIDE_PX = 20_000

ALWAYS = datetime(1970, 1, 1, tzinfo=UTC)
"""From when the exact calibration of a virtual rig is valid, unless its file says otherwise."""

Vector: TypeAlias = tuple[float, float, float]

_POSITIVE = (
    *("width_mm", "height_mm", "radius_mm", "size_mm", "depth_mm", "diameter_mm"),
    *("pitch_mm", "length_mm", "sigma_mm", "pitch_relative_sigma"),
    *("exposure", "full_well", "gamma", "strength", "exponent"),
)
"""Endings of the names of fields that must be above zero."""
_NOT_NEGATIVE = frozenset(
    {"read_noise", "blur_px", "defocus_px", "ambient", "hole_offset_mm", "seed", "margin_mm"}
)
_FRACTIONS = frozenset({"dark", "bright", "visibility", "mirror_reflectance"})


@dataclass(frozen=True)
class CampaignPlan:
    """What a campaign file defines.

    Attributes
    ----------
    campaign
        The test.
    calibration
        For a virtual rig: its exact parameters; None for a real one, which is calibrated by measurement.
    """

    campaign: Campaign
    calibration: Calibration | None


class _Table(BaseModel):
    """A table of the file: exact types, finite numbers, known keys alone."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, value: Any) -> Any:
        known = [f.alias or name for name, f in cls.model_fields.items()]
        for key in value if isinstance(value, dict) else ():
            if key not in known:
                raise PydanticCustomError(
                    "unknown_key",
                    "has no key '{key}'; its keys are {known}",
                    {"key": key, "known": ", ".join(known)},
                )
        return value


@cache
def _table_of(record: type) -> Any:
    """Return the table that describes a flat record: its fields, radians written as degrees."""
    hints = get_type_hints(record)
    columns: dict[str, Any] = {}
    for f in fields(record):
        limits: dict[str, Any] = {}
        if f.name.endswith("angle_rad"):
            limits = {"gt": 0.0, "le": 180.0}
        elif f.name.endswith(_POSITIVE):
            limits = {"gt": 0.0}
        elif f.name in _NOT_NEGATIVE:
            limits = {"ge": 0}
        elif f.name in _FRACTIONS:
            limits = {"ge": 0.0, "le": 1.0}
        kind = hints[f.name]
        if limits and kind == tuple[float, float]:
            one = Annotated[float, Field(**limits)]
            kind, limits = tuple[one, one], {}
        name = f.name.removesuffix("_rad") + "_deg" if f.name.endswith("_rad") else f.name
        default = f.default if f.default is not MISSING else ...
        if name in ("shape", "motion"):
            default = ...  # the file says what it is
        elif name != f.name and default is not ...:
            default = _map(np.degrees, default)
        columns[name] = (kind, Field(default, **limits))
    return create_model(record.__name__, __base__=_Table, **columns)


def _map(function: Any, value: Any) -> Any:
    """Apply a function of one number to a number or to each of a tuple."""
    return tuple(float(function(v)) for v in value) if isinstance(value, tuple) else float(function(value))


def _record(kind: type, table: Any) -> Any:
    """Return the flat record that a table describes."""
    values = {}
    for f in fields(kind):
        if f.name.endswith("_rad"):
            values[f.name] = _map(radians, getattr(table, f.name.removesuffix("_rad") + "_deg"))
        else:
            values[f.name] = getattr(table, f.name)
    return kind(**values)


def _flat(*kinds: type, tag: str | None = None) -> GetPydanticSchema:
    """Read one of several flat records, told apart by the value of their field `tag`."""
    kind_of = {_table_of(kind): kind for kind in kinds}
    table: Any = Union[tuple(kind_of)]  # noqa: UP007
    if tag is not None:
        table = Annotated[table, Field(discriminator=tag)]
    return GetPydanticSchema(
        lambda _, handler: core_schema.no_info_after_validator_function(
            lambda found: _record(kind_of[type(found)], found), handler(table)
        )
    )


_Surface: TypeAlias = Annotated[
    scenes.Surface,
    _flat(
        scenes.Plane,
        scenes.Cylinder,
        scenes.Sphere,
        scenes.PlateWithHoleAndStep,
        scenes.TopHat,
        scenes.PlateAndMirror,
        CircleBoard,
        Chessboard,
        BallBar,
        tag="shape",
    ),
]
_Motion: TypeAlias = Annotated[
    scenes.Deformation,
    _flat(
        scenes.Rigid,
        scenes.PanTilt,
        scenes.UniaxialStrain,
        scenes.MidPointBending,
        scenes.HalvesApart,
        tag="motion",
    ),
]


class _Pose(_Table):
    """Where the specimen stands: a rotation vector in degrees, then a translation."""

    rotation_deg: Vector = (0.0, 0.0, 0.0)
    translation_mm: Vector = (0.0, 0.0, 0.0)

    def record(self) -> Pose:
        matrix = Rotation.from_rotvec(self.rotation_deg, degrees=True).as_matrix()
        return Pose.from_arrays(matrix, np.array(self.translation_mm))


Pixels = Annotated[int, Field(ge=1, le=LONGEST_SIDE_PX)]
Focal = Annotated[float, Field(gt=0.0)]


def _sensor_name(name: str) -> str:
    if not re.fullmatch(r"[CP][1-9][0-9]{0,2}", name):
        raise PydanticCustomError(
            "sensor_name",
            "should be C1, C2, ... for a camera or P1, P2, ... for a projector, not '{name}'",
            {"name": name},
        )
    return name


class _Sensor(_Table):
    """A camera or projector, placed by what it looks at or by its rotation and translation."""

    name: Annotated[str, AfterValidator(_sensor_name)]
    columns: Pixels
    rows: Pixels
    fx: Focal
    fy: Focal
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    position_mm: Vector | None = None
    target_mm: Vector | None = None
    up: Vector = (0.0, 1.0, 0.0)
    rotation: tuple[Vector, Vector, Vector] | None = None
    translation_mm: Vector | None = None

    def _pose(self) -> Pose:
        if self.position_mm is not None and self.target_mm is not None:
            axis = np.subtract(self.target_mm, self.position_mm)
            if np.linalg.norm(np.cross(axis, self.up)) <= 1e-9 * np.linalg.norm(axis) * np.linalg.norm(
                self.up
            ):
                raise InvalidInput(
                    f"sensor {self.name} cannot look along {axis.tolist()} mm with up = {list(self.up)}: "
                    "give a target away from its position and an up that is not parallel to its view"
                )
            return Pose.looking_at(np.array(self.position_mm), np.array(self.target_mm), np.array(self.up))
        matrix = np.array(self.rotation)
        departure = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
        if departure > 1e-6 or np.linalg.det(matrix) < 0.0:
            raise InvalidInput(
                f"sensor {self.name} has a rotation that is no right-handed rotation matrix: R R^T differs "
                f"from 1 by {departure:.2g}, allowed is 1e-6"
            )
        return Pose.from_arrays(matrix, np.array(self.translation_mm))

    @model_validator(mode="after")
    def _placed_once(self) -> _Sensor:
        looking = (self.position_mm is not None, self.target_mm is not None)
        turned = (self.rotation is not None, self.translation_mm is not None)
        if not (looking == (True, True) and turned == (False, False)) and not (
            looking == (False, False) and turned == (True, True)
        ):
            raise PydanticCustomError(
                "placement", "needs either position_mm and target_mm, or rotation and translation_mm"
            )
        return self

    def record(self) -> Sensor:
        intrinsics = Intrinsics(**{f.name: getattr(self, f.name) for f in fields(Intrinsics)})
        role = Role.CAMERA if self.name.startswith("C") else Role.PROJECTOR
        return Sensor(self.name, role, self.columns, self.rows, intrinsics, self._pose())


class _Volume(_Table):
    low_mm: Vector
    high_mm: Vector

    @model_validator(mode="after")
    def _not_empty(self) -> _Volume:
        if any(low >= high for low, high in zip(self.low_mm, self.high_mm, strict=True)):
            raise PydanticCustomError("empty", "needs every coordinate of low_mm below that of high_mm")
        return self


class _Scene(_Table):
    sensors: tuple[_Sensor, ...]
    volume: _Volume
    surface: _Surface
    speckle: Annotated[Speckle, _flat(Speckle)] | None = None
    placement: _Pose = _Pose()
    camera: Annotated[CameraResponse, _flat(CameraResponse)] = CameraResponse()
    projector: Annotated[ProjectorResponse, _flat(ProjectorResponse)] = ProjectorResponse()
    seed: Annotated[int, Field(ge=0)] = 0
    gloss: Annotated[Gloss, _flat(Gloss)] | None = None
    calibration_valid_from: AwareDatetime = ALWAYS

    def record(self, rig: str) -> Scene:
        sensors = sorted((s.record() for s in self.sensors), key=lambda s: (s.name[0], int(s.name[1:])))
        names = [s.name for s in sensors]
        if len(set(names)) < len(names):
            raise InvalidInput(f"two sensors of the scene have one name: {', '.join(names)}")
        return Scene(
            rig=Rig(rig, tuple(sensors)),
            surface=self.surface,
            speckle=self.speckle,
            placement=self.placement.record(),
            camera=self.camera,
            projector=self.projector,
            seed=self.seed,
            gloss=self.gloss,
        )


class _Specimen(_Table):
    name: Annotated[str, Field(min_length=1)]
    material: str = ""
    description: str = ""


class _State(_Table):
    label: str
    load_n: float | None = None
    displacement_mm: float | None = None
    time: AwareDatetime | None = None
    channels: dict[str, float] = Field(default_factory=dict)
    deformation: tuple[_Motion, ...] = ()

    def record(self) -> LoadState:
        return LoadState(
            self.label, self.load_n, self.displacement_mm, self.time, dict(self.channels), self.deformation
        )


def _densities(value: Any) -> Any:
    """Return the list that a name such as "fdr-64" stands for."""
    if not isinstance(value, str):
        return value
    try:
        return named_sequence(value)
    except InvalidInput as error:
        raise PydanticCustomError("unknown_sequence", "{why}", {"why": f"is unknown: {error}"}) from None


class _Sequence(_Table):
    densities: Annotated[tuple[int, ...], BeforeValidator(_densities)] = FringeSequence().densities
    steps: int = FringeSequence().steps
    orientations_deg: tuple[float, ...] = (0.0, 90.0)
    exposures: tuple[float, ...] = FringeSequence().exposures

    def record(self) -> FringeSequence:
        return FringeSequence(
            self.densities, self.steps, _map(radians, self.orientations_deg), self.exposures
        )


class CampaignTable(_Table):
    """The whole of a campaign file."""

    name: str
    rig: str
    specimen: _Specimen
    states: tuple[_State, ...]
    pairs: tuple[str, ...] | None = None
    sequence: _Sequence = _Sequence()
    scene: _Scene | None = None
    processing: dict[str, dict[str, ParameterValue]] = Field(default_factory=dict)

    def plan(self) -> CampaignPlan:
        """Return the records, checked against each other."""
        scene = None if self.scene is None else self.scene.record(self.rig)
        calibration = None
        if self.scene is not None and scene is not None:
            calibration = Calibration(
                rig=scene.rig,
                volume=Box(self.scene.volume.low_mm, self.scene.volume.high_mm),
                valid_from=self.scene.calibration_valid_from.astimezone(UTC),
                origin="exact parameters of the virtual rig",
            )
        campaign = Campaign(
            name=self.name,
            specimen=Specimen(self.specimen.name, self.specimen.material, self.specimen.description),
            rig=self.rig,
            states=tuple(s.record() for s in self.states),
            pairs=self._checked_pairs(calibration),
            sequence=self.sequence.record(),
            scene=scene,
            processing={kind: dict(parameters) for kind, parameters in self.processing.items()},
        )
        for state in campaign.states:
            if scene is None and state.deformation:
                raise InvalidInput(
                    f"state {state.label} has a deformation, but only the specimen of a virtual rig, "
                    "described under [scene], can be given one"
                )
        return CampaignPlan(campaign, calibration)

    def _checked_pairs(self, calibration: Calibration | None) -> tuple[str, ...]:
        """Return the pairs that measure, each once and of sensors that exist."""
        if calibration is not None and not calibration.rig.pairs():
            raise InvalidInput(
                "the scene needs at least one camera and one projector under [[scene.sensors]]"
            )
        if calibration is not None and self.pairs is None:
            return calibration.rig.pairs()
        if not self.pairs:
            raise InvalidInput("pairs is missing or empty: name those that measure, such as ['C1P1', 'C1P2']")
        for pair in self.pairs:
            names = split_pair(pair)
            if calibration is not None:
                for name in names:
                    calibration.rig.sensor(name)
        if len(set(self.pairs)) < len(self.pairs):
            raise InvalidInput(f"pairs names one pair twice: {', '.join(self.pairs)}")
        return self.pairs
