"""The tables of a calibration session in a campaign file: artefacts, sensors, and where the world is."""

from __future__ import annotations

from math import pi, radians
from typing import Annotated, Literal, TypeAlias

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.record_tables import Placement, Table, Volume, flat, mapped
from sms_jobs.metrology.geometry.stage_poses import AngleRange, uniform_poses
from sms_jobs.metrology.targets.patterns import goes_around, seam_pitches
from sms_jobs.records.artefacts import Artefact, BallBar, Chessboard, CircleBoard, DotCylinder, Place
from sms_jobs.records.campaign import CalibrationSession, LoadState
from sms_jobs.records.scene import PanTilt, Rigid
from sms_jobs.records.sensors import Rig, SensorFormat
from sms_jobs.records.subject import checked_name
from sms_jobs.records.views import place_of, role_of, view_of

LONGEST_SIDE_PX = 20_000

_STEEPEST_PITCH = 0.18
"""Of the diameter: 20 degrees, of which five columns are seen less obliquely than 50 degrees."""

_NEAREST_PITCHES, _WIDEST_PITCHES = 0.9, 1.5
"""Across the seam of a cylinder: below, columns overlap; up to the second a lattice may step across."""

_SEEN_WHOLE = 0.25
"""Of the way around: what a camera sees less obliquely than 45 degrees."""

ARTEFACTS = (CircleBoard, DotCylinder, Chessboard, BallBar)

Pixels = Annotated[int, Field(ge=1, le=LONGEST_SIDE_PX)]
_Artefact: TypeAlias = Annotated[Artefact, flat(*ARTEFACTS, tag="shape")]


def sensor_name(name: str) -> str:
    """Return the name of a sensor; refuse any but C1, C2, ... and P1, P2, ..."""
    try:
        role_of(name)
    except InvalidInput as error:
        raise PydanticCustomError(
            "sensor_name",
            "should be C1, C2, ... for a camera or P1, P2, ... for a projector, not '{name}'",
            {"name": name},
        ) from error
    return name


class _Format(Table):
    name: Annotated[str, AfterValidator(sensor_name)]
    columns: Pixels
    rows: Pixels


class _StagePoses(Table):
    """Poses of an artefact on a pan-tilt stage, by their number and ranges (thesis section 3.2.2)."""

    artefact: str
    count: Annotated[int, Field(ge=1, le=1000)]
    pan_deg: tuple[float, float]
    tilt_deg: tuple[float, float]
    order: Literal["serpentine", "random"] = "serpentine"
    seed: Annotated[int, Field(ge=0)] = 0
    tripod: Placement | None = None

    def states(self, virtual: bool) -> tuple[LoadState, ...]:
        """Return a state for each pose; before a virtual rig the stage stands where `tripod` says."""
        if virtual != (self.tripod is not None):
            raise InvalidInput(
                "session.stage_poses.tripod is missing: say where the stage stands before the virtual rig"
                if virtual
                else "session.stage_poses.tripod has no place before a real rig, whose stage stands where it "
                "stands: leave it out"
            )
        pan, tilt = (_range(name, getattr(self, name)) for name in ("pan_deg", "tilt_deg"))
        found = []
        for number, pose in enumerate(uniform_poses(self.count, pan, tilt, self.order, self.seed), start=1):
            stage = PanTilt(pose.pan_rad, pose.tilt_rad)
            placed = () if self.tripod is None else (stage, _rigid(self.tripod))
            angles = {"pan_rad": pose.pan_rad, "tilt_rad": pose.tilt_rad}
            found.append(
                LoadState(f"S{number:02d}", channels=angles, deformation=placed, artefact=self.artefact)
            )
        return tuple(found)


def _range(name: str, ends_deg: tuple[float, float]) -> AngleRange:
    low, high = ends_deg
    if not low < high:
        raise InvalidInput(
            f"session.stage_poses.{name} goes from {low:g} to {high:g} degrees: give the lower end first"
        )
    return AngleRange(radians(low), radians(high))


def _rigid(placement: Placement) -> Rigid:
    return Rigid(mapped(radians, placement.rotation_deg), placement.translation_mm)


class SessionTable(Table):
    """What makes a campaign a calibration session."""

    artefacts: dict[str, _Artefact]
    sensors: tuple[_Format, ...] = ()
    volume: Volume | None = None
    board_in_world: Placement = Placement()
    starts_from: Literal["nothing", "last-calibration"] = "nothing"
    stage_poses: _StagePoses | None = None

    def first_artefact(self, name: str | None) -> Artefact:
        """Return the artefact of a name, or any where there is none of that name."""
        if not self.artefacts:
            raise InvalidInput(
                "session.artefacts is empty: describe a board, a cylinder or a ball bar under "
                "[session.artefacts.<name>]"
            )
        return self.artefacts.get(name or "", next(iter(self.artefacts.values())))

    def record(
        self, states: tuple[LoadState, ...], views: tuple[str, ...], rig: Rig | None, scene: Volume | None
    ) -> CalibrationSession:
        """Return the session, checked against its states and against the virtual rig if there is one.

        `scene` is the volume that the scene of a virtual rig names: it holds where the session has none.
        """
        self.first_artefact(None)
        for name, artefact in self.artefacts.items():
            checked_name(name, "calibration artefact")
            check_artefact(name, artefact)
        for state in states:
            self._check_state(state)
        volume = self.volume or scene
        return CalibrationSession(
            artefacts=dict(self.artefacts),
            sensors=self._formats(views, rig),
            volume=None if volume is None else volume.record(),
            board_in_world=_rigid(self.board_in_world),
            starts_from=self.starts_from,
        )

    def _check_state(self, state: LoadState) -> None:
        if state.artefact is None:
            raise InvalidInput(
                f"state {state.label} shows no artefact: in a calibration session every state names one as "
                f"its artefact, here {' or '.join(self.artefacts)}"
            )
        for motion in state.deformation:
            if not isinstance(motion, Rigid | PanTilt):
                raise InvalidInput(
                    f"state {state.label} deforms {state.artefact} by {motion.motion}, but artefacts are "
                    "stiff: move them by rigid and pan-tilt alone"
                )

    def _formats(self, views: tuple[str, ...], rig: Rig | None) -> tuple[SensorFormat, ...]:
        """Return the sizes of the images of all sensors, cameras first."""
        if rig is not None:
            if self.sensors:
                raise InvalidInput(
                    "session.sensors repeats what [[scene.sensors]] says of the virtual rig: leave it out"
                )
            return tuple(SensorFormat(s.name, s.columns, s.rows) for s in rig.sensors)
        found = {s.name: SensorFormat(s.name, s.columns, s.rows) for s in self.sensors}
        if len(found) < len(self.sensors):
            raise InvalidInput(
                f"two sensors of the session have one name: {', '.join(s.name for s in self.sensors)}"
            )
        for view in views:
            for name in view_of(view).sensors:
                if name not in found:
                    raise InvalidInput(
                        f"the session does not say how many pixels {name} of view {view} has: add it under "
                        "[[session.sensors]]"
                    )
        return tuple(sorted(found.values(), key=lambda s: place_of(s.name)))


def check_artefact(name: str, artefact: Artefact) -> None:
    """Refuse an artefact that cannot be built."""
    if isinstance(artefact, BallBar):
        if artefact.length_mm <= 2.0 * artefact.radius_mm:
            raise InvalidInput(
                f"the spheres of {name}, of radius {artefact.radius_mm} mm, touch at a length of "
                f"{artefact.length_mm} mm: length_mm is the distance of their centres"
            )
    elif isinstance(artefact, DotCylinder):
        _check_cylinder(name, artefact)
        _check_circles(name, artefact)
    elif isinstance(artefact, CircleBoard):
        _check_circles(name, artefact)


def _check_cylinder(name: str, cylinder: DotCylinder) -> None:
    """Refuse a cylinder that its columns do not fit, or of which nobody can tell which part is seen."""
    around, seam = pi * cylinder.diameter_mm, seam_pitches(cylinder)
    if min(cylinder.columns, cylinder.rows) < 3:
        raise InvalidInput(
            f"{name} has {cylinder.columns} columns and {cylinder.rows} rows: a cylinder needs three of both"
        )
    if cylinder.pitch_mm > cylinder.diameter_mm * _STEEPEST_PITCH:
        raise InvalidInput(
            f"the pitch of {name}, {cylinder.pitch_mm:g} mm, is more than {_STEEPEST_PITCH:g} of its "
            f"diameter of {cylinder.diameter_mm:g} mm, so that too few columns are seen: take a finer pitch"
        )
    if seam < _NEAREST_PITCHES:
        raise InvalidInput(
            f"{cylinder.columns} columns of {name} at a pitch of {cylinder.pitch_mm:g} mm need "
            f"{cylinder.columns * cylinder.pitch_mm:g} mm around, and a diameter of "
            f"{cylinder.diameter_mm:g} mm has {around:.4g} mm: correct columns, pitch_mm or diameter_mm"
        )
    if not goes_around(cylinder) and seam < _WIDEST_PITCHES:
        raise InvalidInput(
            f"the first and the last column of {name} are {seam:.2f} pitches apart across the seam, too near "
            f"to tell from neighbours and too far to be some: leave a column out, or let "
            f"{cylinder.columns} columns go around {cylinder.columns * cylinder.pitch_mm / pi:.4g} mm"
        )
    if cylinder.markers is None and (cylinder.columns - 1) * cylinder.pitch_mm > _SEEN_WHOLE * around:
        raise InvalidInput(
            f"no camera sees all {cylinder.columns} columns of {name}, and without markers nobody can tell "
            "which of them it sees: give it markers"
        )
    if cylinder.markers is not None and len(cylinder.markers) < 3:
        raise InvalidInput(f"{name} has {len(cylinder.markers)} markers: origin, x and y are the first three")


def _check_circles(name: str, board: CircleBoard | DotCylinder) -> None:
    """Refuse a board with overlapping dots, or markers that define no axes or look like dots."""
    if board.markers is not None:
        _check_markers(name, board, board.markers)
    largest = max(board.marker_diameter_mm, board.dot_diameter_mm)
    if (largest + board.dot_diameter_mm) / 2.0 >= board.pitch_mm:
        raise InvalidInput(
            f"the dots of {name} overlap: diameters of {board.dot_diameter_mm} and "
            f"{board.marker_diameter_mm} mm at a pitch of {board.pitch_mm} mm"
        )


def _check_markers(name: str, board: CircleBoard | DotCylinder, markers: tuple[Place, ...]) -> None:
    """Refuse markers that define no axes or look like dots."""
    for column, row in markers:
        if not (0 <= column < board.columns and 0 <= row < board.rows):
            raise InvalidInput(
                f"the marker ({column}, {row}) of {name} is not on its {board.columns} x {board.rows} dots: "
                "give columns and rows counted from 0"
            )
    (column, row), (second, second_row), (third_column, third) = markers[:3]
    if second_row != row or third_column != column or second == column or third == row:
        raise InvalidInput(
            f"the markers of {name} define no axes: the second must share the row of the first, the third "
            f"its "
            "column"
        )
    if board.marker == "ring" and not 0.0 < board.marker_hole_mm < board.marker_diameter_mm:
        raise InvalidInput(
            f"the rings of {name} need marker_hole_mm between 0 and marker_diameter_mm, not "
            f"{board.marker_hole_mm} of {board.marker_diameter_mm} mm"
        )
    if board.marker == "larger-dot" and not board.marker_diameter_mm > board.dot_diameter_mm:
        raise InvalidInput(
            f"the markers of {name}, larger dots, need a marker_diameter_mm above the "
            f"{board.dot_diameter_mm} mm of other dots, not {board.marker_diameter_mm} mm"
        )
