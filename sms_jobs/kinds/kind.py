"""What a job kind is: a declaration that the planner reads and a pure function that the runner calls.

A module of this package that has a `KIND` is a job kind; there is nothing else to register. The runner
alone loads inputs, stores outputs, hashes and reports.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from sms_jobs.kinds.documents import Document, DocumentOutput
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.records.input_roles import role_at
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import View, view_of

if TYPE_CHECKING:
    from sms_jobs.kinds.products import Dataset, Product
    from sms_jobs.records.campaign import Campaign, LoadState
    from sms_jobs.records.optical_instruments import RigFile

R = TypeVar("R")


P = TypeVar("P", bound=Parameters)


class Scope(Enum):
    """What one job of a kind covers."""

    CAMPAIGN = "campaign"
    STATE = "state"
    TUPLE = "tuple"


class Queue(Enum):
    """The resource that a job needs, and so the queue that its messages go through."""

    CPU = "cpu"
    IO = "io"
    ACQUISITION = "acquisition"


MEASUREMENT = "measurement"
CALIBRATION = "calibration"
REFERENCE_SURFACES = "surface"
"""The sources of files that no job kind alone makes."""


@dataclass(frozen=True)
class Port:
    """One input of a kind, as its jobs have it.

    Attributes
    ----------
    name
        By which `run` asks for it, and which tells in a result's history what an input was for.
    source
        `MEASUREMENT`, `CALIBRATION`, `REFERENCE_SURFACES`, or the name of the kind whose result is needed.
    products
        The records of it that may be read.
    several
        Whether a job has one for each of several subjects.
    """

    name: str
    source: str
    products: tuple[Product[Any], ...]
    several: bool = False

    def of(self, subject: Subject) -> Need:
        """Return the need for what is about a subject; a calibration is for it, at its state's time."""
        return Need(self, subject)

    def made_by(self, source: str) -> Port:
        """Return the same of another source."""
        return replace(self, source=source)

    def role(self, subject: Subject) -> str:
        """Return under which name a job keeps the input about a subject."""
        return role_at(self.name, subject if self.several else None)


@dataclass(frozen=True)
class Need:
    """What a job needs at one of its ports."""

    port: Port
    subject: Subject

    @property
    def role(self) -> str:
        """Under which name the job keeps it."""
        return self.port.role(self.subject)

    @property
    def source(self) -> str:
        """What makes it."""
        return self.port.source


class Progress(Protocol):
    """Tells how far a job has come; raises `Cancelled` when the job is to stop."""

    def __call__(self, fraction: float, message: str = "") -> None:
        """Report `fraction`, 0 .. 1, of the work done."""
        ...


@dataclass(frozen=True)
class Station:
    """Where the instruments of a rig are connected.

    Attributes
    ----------
    rig
        What the rig's file on this host says.
    spool
        A folder of the job's own on a local disk, for frames as they come in. It stays until the job has
        succeeded, whatever happens.
    """

    rig: RigFile
    spool: Path


@dataclass(frozen=True)
class Inputs:
    """What `run` is given besides its parameters.

    Attributes
    ----------
    subject
        What the job is about.
    context
        What the kind's `context` took from the campaign's definition.
    datasets
        The needs, by role.
    threads
        How many threads the job may use; results must not depend on it.
    station
        For kinds that work with instruments.
    """

    subject: Subject
    context: Any
    datasets: Mapping[str, Dataset]
    threads: int = 1
    station: Station | None = None

    @property
    def view(self) -> View:
        """How the tuple is seen; raises `InvalidInput` for a job about more than a tuple."""
        return view_of(self.subject.view)

    def has(self, port: Port, product: Product[Any] | None = None, about: Subject | None = None) -> bool:
        """Say whether there is an input at a port, and in it a record."""
        found = self.datasets.get(port.role(about or self.subject))
        return found is not None and (product is None or product.is_in(found))

    def read(self, port: Port, product: Product[R], about: Subject | None = None) -> R:
        """Read a record of what is at a port; of a port with several, of what is about a subject."""
        if product.any_key not in port.products:
            raise TypeError(f"port {port.name} does not declare that {product.stored_as} is read")
        return product.read(self.datasets[port.role(about or self.subject)])

    def about(self, port: Port) -> tuple[Subject, ...]:
        """Return what the inputs at a port with several are about, in the order of the needs."""
        each = (dataset.subject for dataset in self.datasets.values())
        return tuple(subject for subject in dict.fromkeys(each) if port.role(subject) in self.datasets)

    def each(self, port: Port, product: Product[R]) -> tuple[Product[R], ...]:
        """Return the records of one name, each with its key, that are at a port."""
        return product.among(self.datasets[port.role(self.subject)].names)


@dataclass(frozen=True)
class DatasetOutput:
    """Records to be sealed in one HDF5 file; the first is shown when the file is opened.

    `statistics` are the numbers of this result that people search by, with units in their names.
    """

    subject: Subject
    products: Mapping[Product[Any], Any]
    statistics: Mapping[str, float]

    @property
    def records(self) -> dict[str, Any]:
        """The records by their names in the file."""
        return {product.stored_as: record for product, record in self.products.items()}


Output = DatasetOutput | DocumentOutput


def no_needs(campaign: Campaign, subject: Subject, parameters: Any) -> Iterable[Need]:
    """Return no need: what is measured starts from nothing."""
    return ()


def no_context(campaign: Campaign, subject: Subject) -> None:
    """Take nothing from the campaign's definition."""


def no_devices(campaign: Campaign, subject: Subject) -> Iterable[str]:
    """Need no device."""
    return ()


def nothing_else(campaign: Campaign, need: Need) -> str:
    """Advise nothing more than the planner does."""
    return ""


def always(parameters: Parameters) -> bool:
    """Say that a job can be run again whatever its parameters."""
    return True


def never(parameters: Parameters) -> bool:
    """Say that a job, which drives instruments, is not run again by itself."""
    return False


@dataclass(frozen=True)
class Kind(Generic[P]):
    """A job kind.

    Attributes
    ----------
    name, summary
        As `sms job submit` shows them.
    version
        Changes whenever the numbers would.
    scope
        What one job covers.
    parameters
        The class of its parameters.
    inputs
        Every port that a job may have, with the records that are read there.
    outputs
        Every record that its results may have, and every document; several of a name are declared with
        what tells them apart.
    needs
        Which inputs a job about a subject has; with `subjects`, all that the planner knows of a kind.
    run
        Pure: yields outputs, takes everything from its arguments.
    subjects
        Overrides the subjects that follow from the scope, e.g. to leave out the reference state. A kind
        that can do nothing in a campaign has none there.
    pipeline_subjects
        Those of its subjects that the pipeline covers, where it is not all of them: what a view with a
        projector measures better, images need not give.
    context
        The part of the campaign's definition that the outputs depend on; hashed into the reuse key.
    repeatable
        True when running again does no harm and gives the same result: such a job is reused, and is
        retried by itself after a crash. An acquisition on real hardware is not.
    makes
        `MEASUREMENT` for kinds that record, else the kind's own name.
    in_pipeline
        Whether `sms job submit pipeline` includes it.
    devices
        Names of the devices that a job has to itself while it runs; it stays queued until they are free.
    with_instruments
        Whether its jobs run where the instruments of the campaign's rig are connected, and hold that rig.
    adds_states
        Whether its results may be about states that the campaign does not have; it is given them.
    otherwise
        What else can be done where a result that it needs is not there, for the error that says so.
    of_some_states
        What a kind whose job is about a whole campaign offers for some of its states, for the error that says
        that they cannot be chosen otherwise.
    along_frame
        Whether its numbers lie along the axes of the specimen's frame, so that another frame makes its
        results stale.
    """

    name: str
    summary: str
    version: int
    scope: Scope
    parameters: type[P]
    inputs: tuple[Port, ...]
    outputs: tuple[Product[Any] | Document, ...]
    needs: Callable[[Campaign, Subject, P], Iterable[Need]]
    run: Callable[[Inputs, P, Progress], Iterator[Output]]
    subjects: Callable[[Campaign], Iterable[Subject]] | None = None
    pipeline_subjects: Callable[[Campaign], Iterable[Subject]] | None = None
    context: Callable[[Campaign, Subject], Any] = no_context
    repeatable: Callable[[P], bool] = always
    queue: Queue = Queue.CPU
    makes: str = ""
    in_pipeline: bool = True
    devices: Callable[[Campaign, Subject], Iterable[str]] = no_devices
    with_instruments: bool = False
    adds_states: bool = False
    otherwise: Callable[[Campaign, Need], str] = nothing_else
    of_some_states: str = ""
    along_frame: bool = False

    def checked_parameters(self, given: Mapping[str, Any]) -> P:
        """Return the parameters, defaults filled in; raise `InvalidInput` for what the kind does not take."""
        return self.parameters.checked(self.name, given)

    def checked_needs(self, campaign: Campaign, subject: Subject, parameters: P) -> tuple[Need, ...]:
        """Return every input of a job about a subject; raise `TypeError` for one that is not declared."""
        found = tuple(self.needs(campaign, subject, parameters))
        for need in found:
            if need.port not in self.inputs:
                raise TypeError(f"{self.name} does not declare its input {need.role} of {need.source}")
        return found

    @property
    def records(self) -> Mapping[Product[Any], Product[Any]]:
        """The records that its results may have: how each is declared, by what it is whatever its key."""
        return {one.any_key: one for one in self.outputs if not isinstance(one, Document)}

    def checked(self, output: Output) -> Output:
        """Return what a job yielded; raise `TypeError` for what is not declared, or is something else."""
        if isinstance(output, DocumentOutput):
            if output.document not in self.outputs:
                raise TypeError(f"{self.name} does not declare its document {output.filename}")
            return output
        records = self.records
        for product, record in output.products.items():
            declared = records.get(product.any_key)
            if declared is None or (product.key and not declared.keyed_by):
                raise TypeError(f"{self.name} does not declare its output {product.stored_as}")
            if not isinstance(record, product.record):
                classes = f"{type(record).__name__}, not {product.record.__name__}"
                raise TypeError(f"{product.stored_as} of {self.name} is {classes}")
        return output

    def queue_for(self, campaign: Campaign) -> str:
        """Return the queue of its jobs about a campaign: with instruments, that of the campaign's rig."""
        return rig_queue(campaign.rig) if self.with_instruments else self.queue.value


def rig_queue(rig: str) -> str:
    """Return the queue of the jobs that work with the instruments of a rig."""
    return f"rig-{rig}"


def tested_states(campaign: Campaign) -> tuple[LoadState, ...]:
    """Return the states that show a specimen; those of a calibration session show an artefact."""
    return tuple(s for s in campaign.states if s.artefact is None)


def tuples(campaign: Campaign) -> tuple[Subject, ...]:
    """Return every tuple whose shape can be measured: specimens alone, states in order, views in order."""
    return _tuples(campaign, campaign.shape_views)


def fringe_tuples(campaign: Campaign) -> tuple[Subject, ...]:
    """Return those of a camera and a projector."""
    return _tuples(campaign, campaign.fringe_views)


def camera_tuples(campaign: Campaign) -> tuple[Subject, ...]:
    """Return those of several cameras that see a texture."""
    return _tuples(campaign, campaign.camera_views)


def tuples_alone(campaign: Campaign) -> tuple[Subject, ...]:
    """Return those of cameras that measure in the plane of their image alone."""
    return _tuples(campaign, campaign.cameras_alone)


def stereo_fringe_tuples(campaign: Campaign) -> tuple[Subject, ...]:
    """Return those of several cameras that see the fringes of one projector."""
    return _tuples(campaign, campaign.stereo_fringe_views)


def deformed_tuples(campaign: Campaign) -> tuple[Subject, ...]:
    """Return every tuple by which displacement is measured: all states but the reference."""
    return _deformed(campaign, _tuples(campaign, campaign.measured_views))


def deformed_views(campaign: Campaign) -> tuple[Subject, ...]:
    """Return every tuple of a specimen but those of the reference state, also of cameras that see more."""
    return _deformed(campaign, _tuples(campaign, campaign.views))


def planes(campaign: Campaign) -> tuple[Subject, ...]:
    """Return the tuples of cameras without a projector at the reference state, whose image is a plane."""
    states = tested_states(campaign)[:1]
    alone = [view for view in campaign.views if view not in {*campaign.shape_views, *campaign.late_views}]
    return tuple(Subject(campaign.name, state.label, view) for state in states for view in alone)


def planes_alone(campaign: Campaign) -> tuple[Subject, ...]:
    """Return those of cameras that measure in no other way, where there is a state to compare with."""
    moved = len(tested_states(campaign)) > 1
    return tuple(one for one in planes(campaign) if moved and one.view in campaign.cameras_alone)


def _tuples(campaign: Campaign, views: tuple[str, ...]) -> tuple[Subject, ...]:
    found = ((s, view) for s in tested_states(campaign) for view in views if view not in s.unseen_by)
    return tuple(Subject(campaign.name, state.label, view) for state, view in found)


def _deformed(campaign: Campaign, subjects: tuple[Subject, ...]) -> tuple[Subject, ...]:
    return tuple(t for t in subjects if is_deformed(campaign, t))


def is_deformed(campaign: Campaign, subject: Subject) -> bool:
    """Say whether a tuple is compared with the reference state, and by a view that has seen that."""
    return subject.state != campaign.reference.label and subject.view not in campaign.late_views


def deformed_states(campaign: Campaign) -> tuple[Subject, ...]:
    """Return every state of a campaign but its reference, if shapes are measured there."""
    return every_deformed_state(campaign) if campaign.shape_views else ()


def every_deformed_state(campaign: Campaign) -> tuple[Subject, ...]:
    """Return every state of a campaign but its reference, whatever is measured there."""
    return tuple(Subject(campaign.name, s.label) for s in tested_states(campaign)[1:])


def default_subjects(kind: Kind[Any], campaign: Campaign) -> tuple[Subject, ...]:
    """Return the subjects of a kind in a campaign, in order; by default those whose shape is measured."""
    if kind.subjects is not None:
        return tuple(kind.subjects(campaign))
    if kind.scope is Scope.TUPLE:
        return tuples(campaign)
    states = tested_states(campaign) if campaign.shape_views else ()
    if kind.scope is Scope.STATE:
        return tuple(Subject(campaign.name, s.label) for s in states)
    return (Subject(campaign.name),) if states else ()


def pipeline_subjects(kind: Kind[Any], campaign: Campaign) -> tuple[Subject, ...]:
    """Return the subjects of a kind that the pipeline covers in a campaign, in order."""
    if not kind.in_pipeline:
        return ()
    if kind.pipeline_subjects is not None:
        return tuple(kind.pipeline_subjects(campaign))
    return default_subjects(kind, campaign)
