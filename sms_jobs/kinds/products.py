"""What jobs give each other: every record of a result, its name in the file and its class."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from sms_jobs.records.alignment import ViewAlignment
from sms_jobs.records.assessment import Assessment
from sms_jobs.records.calibration import CalibrationFactor, CalibrationQuality, CalibrationUncertainty
from sms_jobs.records.cracks import CrackOpenings
from sms_jobs.records.diagnosis import ResponseDiagnosis
from sms_jobs.records.fields import (
    DisplacementField,
    ImageMatches,
    MergedField,
    Mesh,
    PhaseMaps,
    PlacesSeen,
    Regions,
    ReturnMaps,
    StrainField,
    Surface,
)
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.observations import BarObservation, BoardObservation
from sms_jobs.records.quick_look import QuickLook
from sms_jobs.records.record_names import RecordName
from sms_jobs.records.recording import FramesBetween, InterruptedRecording, Recording
from sms_jobs.records.rigid_motion import RegionMotion
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.surfaces import DeviationField, ReferenceSurface, SurfaceRegistration
from sms_jobs.records.system_test import SystemTest

if TYPE_CHECKING:
    from sms_jobs.records.subject import Subject

R = TypeVar("R")


class Dataset(Protocol):
    """One file of the archive, open for reading."""

    @property
    def subject(self) -> Subject:
        """What the file is about."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the records it holds."""
        ...

    def read(self, name: str, record: type[R]) -> R:
        """Read one record; frame stacks stay in the file and are streamed."""
        ...


@dataclass(frozen=True)
class Product(Generic[R]):
    """A record of a result.

    Attributes
    ----------
    name
        In the file.
    record
        Its class.
    key
        Which one, where a file has several of a name, such as one for each camera.
    keyed_by
        What keys are, as a kind declares it that gives several of a name; empty elsewhere.
    """

    name: str
    record: type[R]
    key: str = ""
    keyed_by: str = ""

    @property
    def stored_as(self) -> str:
        """The name of the record in the file."""
        return str(RecordName(self.name, self.key))

    @property
    def any_key(self) -> Product[R]:
        """The same whatever the key."""
        return replace(self, key="", keyed_by="")

    def of(self, key: str) -> Product[R]:
        """Return the one of several with a key."""
        return replace(self, key=key)

    def by(self, keys: str) -> Product[R]:
        """Return the declaration that results have several of it, told apart by a camera, a state, ..."""
        return replace(self, keyed_by=keys)

    def among(self, names: Iterable[str]) -> tuple[Product[R], ...]:
        """Return those of this name that a file with records of some names has, in its order."""
        parsed = map(RecordName.parse, names)
        return tuple(self.of(one.key) for one in parsed if one.name == self.name)

    def is_in(self, dataset: Dataset) -> bool:
        """Say whether a file has it."""
        return self.stored_as in dataset.names

    def read(self, dataset: Dataset) -> R:
        """Read it from a file that has it; raises as the file does."""
        return dataset.read(self.stored_as, self.record)

    def read_if_there(self, dataset: Dataset) -> R | None:
        """Read it from a file; None where that has none."""
        return self.read(dataset) if self.is_in(dataset) else None


MEASURED = Product("measurement", Measurement)
RECORDED = Product("recording", Recording)
INTERRUPTED = Product("interrupted", InterruptedRecording)
BETWEEN = Product("between", FramesBetween)
CALIBRATED = Product("calibration", Calibration)
QUALITY = Product("quality", CalibrationQuality)
UNCERTAINTY = Product("uncertainty", CalibrationUncertainty)
CALIBRATION_FACTOR = Product("factor", CalibrationFactor)
BOARD = Product("observation", BoardObservation)
BAR = Product("observation", BarObservation)
SURFACE = Product("surface", Surface)
PLACES = Product("places", PlacesSeen)
PHASE = Product("phase", PhaseMaps)
RETURNS = Product("returns", ReturnMaps)
RESPONSE = Product("response", ResponseDiagnosis)
DISPLACEMENT = Product("displacement", DisplacementField)
MATCHES = Product("matches", ImageMatches)
REGIONS = Product("regions", Regions)
STRAIN = Product("strain", StrainField)
GAUGES = Product("gauges", GaugeReadings)
QUICK_LOOK = Product("look", QuickLook)
CRACKS = Product("cracks", CrackOpenings)
RELATIVE = Product("relative", DisplacementField)
MOTION = Product("motion", RegionMotion)
MERGED = Product("merged", MergedField)
MESH = Product("mesh", Mesh)
ALIGNMENT = Product("view", ViewAlignment)
REFERENCE_SURFACE = Product("reference", ReferenceSurface)
DEVIATION = Product("deviation", DeviationField)
REGISTRATION = Product("registration", SurfaceRegistration)
ASSESSMENT = Product("assessment", Assessment)
SYSTEM_TEST = Product("system", SystemTest)
