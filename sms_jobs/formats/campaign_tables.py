"""The tables of a campaign file: what keys they have, what values are possible, which records they make.

Keys are the names of the records' fields, with angles in degrees (`..._deg`) instead of radians.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field, fields, replace
from datetime import UTC, datetime
from math import radians
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import (
    AfterValidator,
    AwareDatetime,
    BeforeValidator,
    Field,
    GetPydanticSchema,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.record_tables import (
    Counts,
    GrayTable,
    Number,
    Placement,
    Table,
    Vector,
    Volume,
    flat,
    mapped,
)
from sms_jobs.formats.session_tables import ARTEFACTS, Pixels, SessionTable, sensor_name
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import LENS, Intrinsics
from sms_jobs.metrology.phase.sequences import named_sequence
from sms_jobs.records import scene as scenes
from sms_jobs.records.baselines import refuse_one_place
from sms_jobs.records.campaign import Campaign, LoadState, ParameterValue, Specimen
from sms_jobs.records.gray_code import Threshold
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import CameraResponse, Gloss, ProjectorResponse, Scene, Speckle
from sms_jobs.records.seen_volumes import refuse_unseen
from sms_jobs.records.sensors import Calibration, Rig, Sensor
from sms_jobs.records.views import role_of, view_of

ALWAYS = datetime(1970, 1, 1, tzinfo=UTC)
"""From when the exact calibration of a virtual rig is valid, unless its file says otherwise."""


@dataclass(frozen=True)
class CampaignPlan:
    """What a campaign file defines.

    Attributes
    ----------
    campaign
        The test.
    calibration
        For a test on a virtual rig: its exact parameters. None for a real rig, which is calibrated by
        measurement, and for a calibration session, whose calibration is what it is to find.
    text
        The file, letter by letter.
    """

    campaign: Campaign
    calibration: Calibration | None
    text: str = field(default="", compare=False)


_Surface: TypeAlias = Annotated[
    scenes.Surface,
    flat(
        scenes.Plane,
        scenes.Cylinder,
        scenes.Sphere,
        scenes.PlateWithHoleAndStep,
        scenes.StiffenedPanel,
        scenes.TopHat,
        scenes.PlateAndMirror,
        *ARTEFACTS,
        tag="shape",
    ),
]


def _possible(motion: scenes.Deformation) -> scenes.Deformation:
    """Return a motion that a specimen can make; what cannot is told with its place in the file."""
    try:
        scenes.refuse_inside_out(motion)
    except InvalidInput as error:
        raise PydanticCustomError("motion", "{why}", {"why": f"cannot be: {error}"}) from None
    return motion


_Motion: TypeAlias = Annotated[
    scenes.Deformation,
    flat(
        scenes.Rigid,
        scenes.PanTilt,
        scenes.UniaxialStrain,
        scenes.MidPointBending,
        scenes.HalvesApart,
        scenes.Disbond,
        scenes.StringerCrack,
        scenes.Bow,
        tag="motion",
    ),
    AfterValidator(_possible),
]


class _Pose(Placement):
    """Where the specimen stands."""

    def record(self) -> Pose:
        # Loaded here, because few commands need it and all that read campaigns would load it.
        from scipy.spatial.transform import Rotation

        matrix = Rotation.from_rotvec(self.rotation_deg, degrees=True).as_matrix()
        return Pose.from_arrays(matrix, np.array(self.translation_mm))


class _Placed(Table):
    """A camera or projector, placed by what it looks at or by its rotation and translation."""

    name: Annotated[str, AfterValidator(sensor_name)]
    columns: Pixels
    rows: Pixels
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
    def _placed_once(self) -> _Placed:
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
        intrinsics = Intrinsics(**{name: getattr(self, name) for name in LENS})
        role = role_of(self.name)
        return Sensor(self.name, role, self.columns, self.rows, intrinsics, self._pose())


_LENS: dict[str, Any] = {
    f.name: (
        float,
        Field(... if f.default is MISSING else f.default, ge=LENS[f.name].low, le=LENS[f.name].high),
    )
    for f in fields(Intrinsics)
}
_SENSOR = create_model("Sensor", __base__=_Placed, **_LENS)
"""The same with the parameters of its lens."""


class _Scene(Table):
    sensors: tuple[Annotated[_Placed, GetPydanticSchema(lambda _, handler: handler(_SENSOR))], ...]
    volume: Volume | None = None
    surface: _Surface | None = None
    speckle: Annotated[Speckle, flat(Speckle)] | None = None
    placement: _Pose = _Pose()
    camera: Annotated[CameraResponse, flat(CameraResponse)] = CameraResponse()
    projector: Annotated[ProjectorResponse, flat(ProjectorResponse)] = ProjectorResponse()
    seed: Annotated[int, Field(ge=0)] = 0
    gloss: Annotated[Gloss, flat(Gloss)] | None = None
    lamp_mm: Vector | None = None
    board_bow_mm: Vector = (0.0, 0.0, 0.0)
    calibration_valid_from: AwareDatetime = ALWAYS

    def record(self, rig: str, surface: scenes.Surface) -> Scene:
        sensors = sorted((s.record() for s in self.sensors), key=lambda s: (s.name[0], int(s.name[1:])))
        names = [s.name for s in sensors]
        if len(set(names)) < len(names):
            raise InvalidInput(f"two sensors of the scene have one name: {', '.join(names)}")
        return Scene(
            rig=Rig(rig, tuple(sensors)),
            surface=surface,
            speckle=self.speckle,
            placement=self.placement.record(),
            camera=self.camera,
            projector=self.projector,
            seed=self.seed,
            gloss=self.gloss,
            lamp_mm=self.lamp_mm,
            board_bow_mm=self.board_bow_mm,
        )


class _Specimen(Table):
    name: Annotated[str, Field(min_length=1)]
    material: str = ""
    description: str = ""


class _State(Table):
    label: str
    load_n: float | None = None
    displacement_mm: float | None = None
    time: AwareDatetime | None = None
    channels: dict[str, float] = Field(default_factory=dict)
    deformation: tuple[_Motion, ...] = ()
    artefact: str | None = None
    pan_deg: float | None = None
    tilt_deg: float | None = None
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1

    @model_validator(mode="after")
    def _both_angles_once(self) -> _State:
        if (self.pan_deg is None) != (self.tilt_deg is None):
            raise PydanticCustomError("angles", "needs both of pan_deg and tilt_deg, or neither")
        if self.pan_deg is not None and {"pan_rad", "tilt_rad"} & self.channels.keys():
            raise PydanticCustomError(
                "angles", "gives the angles twice: leave out pan_rad and tilt_rad of its channels"
            )
        return self

    def records(self) -> tuple[LoadState, ...]:
        """Return the state as often as it is recorded: S03, S03.2, S03.3, ...; each is a state of its own."""
        first = self._record()
        again = (replace(first, label=f"{self.label}.{n}") for n in range(2, self.repeats + 1))
        return first, *again

    def _record(self) -> LoadState:
        return LoadState(
            self.label,
            self.load_n,
            self.displacement_mm,
            self.time,
            self._angles() | self.channels,
            self.deformation,
            self.artefact,
        )

    def _angles(self) -> dict[str, float]:
        """Return the angles of the stage as channels; on a virtual rig they are those it was sent to."""
        if self.pan_deg is not None and self.tilt_deg is not None:
            return {"pan_rad": radians(self.pan_deg), "tilt_rad": radians(self.tilt_deg)}
        for motion in self.deformation:
            if isinstance(motion, scenes.PanTilt):
                return {"pan_rad": motion.pan_rad, "tilt_rad": motion.tilt_rad}
        return {}


def _densities(value: Any) -> Any:
    """Return the list that a name such as "fdr-64" stands for."""
    if not isinstance(value, str):
        return value
    try:
        return named_sequence(value)
    except InvalidInput as error:
        raise PydanticCustomError("unknown_sequence", "{why}", {"why": f"is unknown: {error}"}) from None


class _Gray(GrayTable):
    threshold: Threshold = "inverse"


class _Sequence(Table):
    densities: Annotated[tuple[Number, ...], BeforeValidator(_densities)] = FringeSequence().densities
    steps: Counts = FringeSequence().steps
    orientations_deg: tuple[float, ...] = (0.0, 90.0)
    exposures: tuple[float, ...] = FringeSequence().exposures
    gray: _Gray | None = None

    def record(self) -> FringeSequence:
        gray = None if self.gray is None else self.gray.code(self.gray.threshold)
        angles = mapped(radians, self.orientations_deg)
        return FringeSequence.with_counts(self.densities, self.steps, angles, self.exposures, gray)


class CampaignTable(Table):
    """The whole of a campaign file."""

    name: str
    rig: str
    specimen: _Specimen
    states: tuple[_State, ...]
    views: tuple[str, ...] | None = None
    sequence: _Sequence = _Sequence()
    scene: _Scene | None = None
    session: SessionTable | None = None
    processing: dict[str, dict[str, ParameterValue]] = Field(default_factory=dict)

    def plan(self) -> CampaignPlan:
        """Return the records, checked against each other."""
        scene = self._scene()
        views = self._checked_views(None if scene is None else scene.rig)
        if scene is not None:
            self._refuse_one_place(scene.rig, views)
        states = tuple(record for s in self.states for record in s.records())
        if self.session is not None and self.session.stage_poses is not None:
            states += self.session.stage_poses.states(virtual=scene is not None)
        volume = None if self.scene is None else self.scene.volume
        if scene is not None and volume is not None:
            refuse_unseen(scene.rig.sensors, volume.record(), "the scene")
        campaign = Campaign(
            name=self.name,
            specimen=Specimen(self.specimen.name, self.specimen.material, self.specimen.description),
            rig=self.rig,
            states=states,
            views=views,
            sequence=self.sequence.record(),
            scene=scene,
            processing={kind: dict(parameters) for kind, parameters in self.processing.items()},
            session=None
            if self.session is None
            else self.session.record(states, views, None if scene is None else scene.rig, volume),
        )
        for state in campaign.states:
            if scene is None and state.deformation:
                raise InvalidInput(
                    f"state {state.label} has a deformation, but only what stands before a virtual rig, "
                    "described under [scene], can be given one"
                )
        return CampaignPlan(campaign, self._calibration(scene))

    def _scene(self) -> Scene | None:
        """Return the virtual rig; in a session with the artefact of the first state before it."""
        if self.scene is None:
            return None
        if self.session is not None:
            shown = self.session.first_artefact(self.states[0].artefact if self.states else None)
            for key in ("surface", "speckle", "gloss", "calibration_valid_from"):
                if key in self.scene.model_fields_set:
                    raise InvalidInput(
                        f"scene.{key} has no place in a calibration session, whose artefacts stand before "
                        "the rig and whose calibration is what is to be found: leave it out"
                    )
            return self.scene.record(self.rig, shown)
        if self.scene.surface is None:
            raise InvalidInput("scene.surface is missing: describe what is in front of the virtual rig")
        return self.scene.record(self.rig, self.scene.surface)

    def _calibration(self, scene: Scene | None) -> Calibration | None:
        """Return the exact calibration of a virtual rig, unless it is to be found."""
        if scene is None or self.scene is None or self.session is not None:
            return None
        if self.scene.volume is None:
            raise InvalidInput("scene.volume is missing: give the corners of the measurement volume")
        return Calibration(
            rig=scene.rig,
            volume=self.scene.volume.record(),
            valid_from=self.scene.calibration_valid_from.astimezone(UTC),
            origin="exact parameters of the virtual rig",
        )

    def _usual_views(self, rig: Rig) -> tuple[str, ...]:
        """Return the views of a virtual rig; in a session, without a projector, each camera by itself."""
        if self.session is None:
            return rig.views()
        return tuple(dict.fromkeys(str(one) for v in rig.views() for one in view_of(v).recordings))

    def _refuse_one_place(self, rig: Rig, views: tuple[str, ...]) -> None:
        """Refuse sensors at one point that measure together, also once a session has calibrated them."""
        pairs = () if self.session is None else (v for v in rig.views() if view_of(v).other_cameras)
        for view in map(view_of, (*views, *pairs)):
            refuse_one_place(map(rig.sensor, view.triangulating), "the scene")

    def _checked_views(self, rig: Rig | None) -> tuple[str, ...]:
        """Return the views that measure, each once and of sensors that exist."""
        usual = () if rig is None else self._usual_views(rig)
        if rig is not None and not usual and not (self.views and rig.sensors):
            raise InvalidInput(
                "the scene needs at least one camera and one projector, or two cameras, under "
                "[[scene.sensors]]; for a camera alone also views = ['C1']"
            )
        if self.views is None and usual:
            return usual
        if not self.views:
            raise InvalidInput("views is missing or empty: name those that measure, such as ['C1P1', 'C1P2']")
        for view in map(view_of, self.views):
            if rig is not None:
                for name in view.sensors:
                    rig.sensor(name)
            if self.session is not None and view.other_cameras:
                raise InvalidInput(
                    f"the view {view} has no place in a calibration session, where each camera finds "
                    f"boards separately: name single cameras, as in views = {[*view.triangulating]}"
                )
        if len(set(self.views)) < len(self.views):
            raise InvalidInput(f"views names one view twice: {', '.join(self.views)}")
        return self.views
