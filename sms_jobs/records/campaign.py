"""A campaign: one specimen, its load states, and how they are measured."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal, TypeAlias

from sms_jobs.errors import InvalidInput, did_you_mean
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.records.artefacts import Artefact
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.numbers import checked_number
from sms_jobs.records.scene import AT_ORIGIN, Deformation, Rigid, Scene
from sms_jobs.records.sensors import Box, SensorFormat
from sms_jobs.records.specimen_frame import SpecimenFrame
from sms_jobs.records.subject import RESERVED_NAME, checked_name
from sms_jobs.records.texts import NAME_LETTERS, checked_text
from sms_jobs.records.times import checked_time
from sms_jobs.records.views import view_of

ParameterValue: TypeAlias = bool | int | float | str | tuple[str, ...]


@dataclass(frozen=True)
class LoadState:
    """One load case.

    Attributes
    ----------
    label
        S00, S01, ...
    load_n, displacement_mm
        Load in N and displacement in mm as they are planned; None where nothing is.
    time
        When the state was held; None before it is measured.
    channels
        Any further scalar readings, by name; of a pan-tilt stage pan_rad and tilt_rad.
    deformation
        For a virtual rig: the exact displacement fields that are applied, one after the other.
    artefact
        In a calibration session: the name of the artefact that stands there in place of a specimen.
    measured_load_n, measured_displacement_mm
        As they were read, where readings were entered or recorded.
    unseen_by
        Views of the campaign that were added once it was recorded, and have no frames of it.
    """

    label: str
    load_n: float | None = None
    displacement_mm: float | None = None
    time: datetime | None = None
    channels: dict[str, float] = field(default_factory=dict)
    deformation: tuple[Deformation, ...] = ()
    artefact: str | None = None
    measured_load_n: float | None = None
    measured_displacement_mm: float | None = None
    unseen_by: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        checked_name(self.label, "state")
        for key in ("load_n", "displacement_mm", "measured_load_n", "measured_displacement_mm"):
            checked_number(getattr(self, key), f"{key} of state {self.label}")
        if self.time is not None:
            checked_time(self.time, f"time of state {self.label}")
        for name, value in self.channels.items():
            checked_text(name, f"the name of a channel of state {self.label}", NAME_LETTERS)
            checked_number(value, f"channel {name} of state {self.label}")

    def planned(self) -> dict[str, float]:
        """Return what channels are to read, by name."""
        return self.channels if self.load_n is None else {"load_n": self.load_n} | self.channels

    @property
    def known_load_n(self) -> float | None:
        """The load as it was read, else as it is planned."""
        return self.load_n if self.measured_load_n is None else self.measured_load_n

    @property
    def known_displacement_mm(self) -> float | None:
        """The displacement as it was read, else as it is planned."""
        measured = self.measured_displacement_mm
        return self.displacement_mm if measured is None else measured


@dataclass(frozen=True)
class Specimen:
    """The thing that is tested."""

    name: str
    material: str = ""
    description: str = ""

    def __post_init__(self) -> None:
        checked_text(self.name, "the name of a specimen", NAME_LETTERS)
        checked_text(self.material, f"the material of specimen {self.name}")
        checked_text(self.description, f"the description of specimen {self.name}")


@dataclass(frozen=True)
class CalibrationSession:
    """What makes a campaign a calibration session: its states are poses of artefacts.

    From nothing, the board of the first state that shows one, as it is there, is the world's frame. A
    session on site starts from the last calibration of the rig and stays in its frame.

    Attributes
    ----------
    artefacts
        By name.
    sensors
        Sizes of the images of the cameras and projectors that are calibrated.
    volume
        Where the calibration is to hold; None for the box around all that is observed.
    board_in_world
        Brings the first board's frame into the world; by default the two are one.
    starts_from
        What the adjustment begins with, and whether the last calibration counts as an observation.
    """

    artefacts: dict[str, Artefact]
    sensors: tuple[SensorFormat, ...]
    volume: Box | None = None
    board_in_world: Rigid = Rigid()
    starts_from: Literal["nothing", "last-calibration"] = "nothing"


@dataclass(frozen=True)
class Campaign:
    """A test of one specimen, or a calibration session.

    Attributes
    ----------
    name
        Unique in the catalogue.
    rig
        Name of the rig that measures it.
    states
        In order of the test; the first is the reference.
    views
        What measures every state: cameras with a projector, several cameras, and cameras that look on alone.
    sequence
        Fringe patterns of every measurement.
    processing
        Parameters of job kinds, by kind and name, that differ from their defaults in this campaign.
    scene
        For a virtual rig: what stands in front of it.
    session
        For a calibration session: what is shown to the rig; None for a test.
    frame
        The specimen's own, as it was found on the measured surface; None where nobody has.
    """

    name: str
    specimen: Specimen
    rig: str
    states: tuple[LoadState, ...]
    views: tuple[str, ...]
    sequence: FringeSequence = FringeSequence()
    scene: Scene | None = None
    processing: dict[str, dict[str, ParameterValue]] = field(default_factory=dict)
    session: CalibrationSession | None = None
    frame: SpecimenFrame | None = None

    def __post_init__(self) -> None:
        checked_name(self.name, "campaign")
        if self.name == RESERVED_NAME:
            raise InvalidInput(
                f"a campaign cannot be called '{RESERVED_NAME}': the archive keeps those there"
            )
        checked_name(self.rig, "rig")
        if not self.states:
            raise InvalidInput(f"campaign {self.name} has no state")
        labels = [s.label for s in self.states]
        if len(set(labels)) < len(labels):
            raise InvalidInput(f"campaign {self.name} has two states of one label: {', '.join(labels)}")
        known = {} if self.session is None else self.session.artefacts
        for state in self.states:
            if state.artefact is not None and state.artefact not in known:
                raise InvalidInput(
                    f"state {state.label} shows the artefact {state.artefact}, which campaign {self.name} "
                    f"does not describe; it describes {', '.join(known) or 'none'}"
                )

    @property
    def reference(self) -> LoadState:
        """The state that displacements are measured from."""
        return self.states[0]

    @property
    def placement(self) -> Pose:
        """What brings the specimen's frame into the world: as it was found, else as the scene has it.

        Where nothing is known of it the two are one.
        """
        if self.frame is not None:
            return self.frame.placement
        return AT_ORIGIN if self.scene is None else self.scene.placement

    @property
    def recordings(self) -> tuple[str, ...]:
        """What is recorded at a state: the views of fringes, and the cameras of the others, once each."""
        return _recordings(self.views)

    def recordings_at(self, label: str) -> tuple[str, ...]:
        """Return what is recorded at a state: `recordings`, without those that came too late for it."""
        unseen = self.state(label).unseen_by
        return _recordings([view for view in self.views if view not in unseen])

    def unseen(self, view: str) -> tuple[str, ...]:
        """Return the labels of the states that were recorded before a view was added, and without it."""
        return tuple(state.label for state in self.states if view in state.unseen_by)

    @property
    def late_views(self) -> frozenset[str]:
        """The views that were added once a state was recorded: they measure shape, and no displacement."""
        return frozenset(view for state in self.states for view in state.unseen_by)

    @property
    def shape_views(self) -> tuple[str, ...]:
        """The views that measure shape: a camera and a projector, several cameras, or both."""
        return tuple(view for view in self.views if view_of(view).measures_shape)

    @property
    def fringe_views(self) -> tuple[str, ...]:
        """The views of a camera and a projector."""
        return self._of_sorts(fringes=True, cameras=False)

    @property
    def camera_views(self) -> tuple[str, ...]:
        """The views of several cameras that see a texture."""
        return self._of_sorts(fringes=False, cameras=True)

    @property
    def stereo_fringe_views(self) -> tuple[str, ...]:
        """The views of several cameras that see the fringes of one projector."""
        return self._of_sorts(fringes=True, cameras=True)

    @property
    def shows_fringes(self) -> bool:
        """Whether anything is seen by the light of a projector."""
        return any(view_of(view).projectors for view in self.views)

    def _of_sorts(self, *, fringes: bool, cameras: bool) -> tuple[str, ...]:
        each = ((view, view_of(view)) for view in self.views)
        return tuple(
            view
            for view, seen in each
            if (bool(seen.projectors), bool(seen.other_cameras)) == (fringes, cameras)
        )

    @property
    def cameras_alone(self) -> tuple[str, ...]:
        """The cameras that have no partner here: what they measure is in the plane of their image."""
        with_shape = {name for view in self.shape_views for name in view_of(view).sensors}
        return tuple(view for view in self.views if view_of(view).camera not in with_shape)

    @property
    def measured_views(self) -> tuple[str, ...]:
        """The views that displacement and strain are measured by: best by each camera."""
        alone, late = self.cameras_alone, self.late_views
        return tuple(v for v in self.views if (v in self.shape_views or v in alone) and v not in late)

    def views_by_camera(self) -> dict[str, tuple[str, ...]]:
        """Return the measured views of each camera, in order."""
        found: dict[str, tuple[str, ...]] = {}
        for view in self.measured_views:
            camera = view_of(view).camera
            found[camera] = (*found.get(camera, ()), view)
        return found

    def state(self, label: str) -> LoadState:
        """Return the state of that label; raise `InvalidInput` where there is none."""
        for state in self.states:
            if state.label == label:
                return state
        known = [s.label for s in self.states]
        meant = did_you_mean(label, known)
        raise InvalidInput(f"campaign {self.name} has no state {label}; {meant}it has {', '.join(known)}")


def _recordings(views: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(str(one) for view in views for one in view_of(view).recordings))


@dataclass(frozen=True)
class CampaignDefinition:
    """What the archive keeps of a campaign, so that the catalogue can be rebuilt from it.

    Attributes
    ----------
    campaign
        As it was registered.
    plan
        The file that it was made from, letter by letter; None where it was made by a program.
    """

    campaign: Campaign
    plan: str | None = None
