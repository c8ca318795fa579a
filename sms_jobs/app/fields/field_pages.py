"""What a page about the fields of a file has to know before it draws any."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from sms_jobs.app.fields.field_sources import SAMPLES, Placed, fields_of, step_of
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns, search
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import FileView
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from sms_jobs.records.campaign import Campaign

_MOST_FILES = 20_000


@dataclass(frozen=True)
class Quantity:
    """A quantity that a map shows.

    Attributes
    ----------
    name, unit
        As they are shown.
    has_sigma, flags
        Whether its standard deviation is known, and whether it says why there is no value.
    record, array, component, scale
        Where a section of this file finds it, and what that is multiplied by; None where it does not.
    """

    name: str
    unit: str
    has_sigma: bool
    flags: bool
    record: str | None
    array: str | None
    component: int | None
    scale: float


@dataclass(frozen=True)
class SimilarResult:
    """A result of the same kind in the same campaign: the newest of its state and view."""

    file: int
    state: str
    view: str
    load_n: float | None


@dataclass(frozen=True)
class Rerun:
    """Another result of the same kind, state and view, and the parameters in which it differs."""

    file: int
    made_at: datetime
    differs: dict[str, Any]


@dataclass(frozen=True)
class FieldPage:
    """What a page about the fields of a file has to know before it draws any.

    Attributes
    ----------
    file
        Of the archive.
    part, parts
        Which of the groups of records, each over one camera's image, and all there are.
    size
        (rows, columns) of the image.
    quantities
        To choose from, the most telling first.
    position, movement
        Names of three quantities that are X, Y, Z of the surface, and of its displacement; None without.
    similar
        In the order of the states, this one among them.
    reruns
        The same computed at other times, the newest first.
    turn, shift
        What brings positions into the frame of gauges, by rows: turn (position - shift), in mm.
    statistics
        Numbers that the file can be found by.
    """

    file: FileView
    part: str
    parts: tuple[str, ...]
    size: tuple[int, int]
    quantities: tuple[Quantity, ...]
    position: tuple[str, ...] | None
    movement: tuple[str, ...] | None
    similar: tuple[SimilarResult, ...]
    reruns: tuple[Rerun, ...]
    turn: tuple[float, ...]
    shift: tuple[float, ...]
    statistics: dict[str, float]

    @property
    def campaign(self) -> str:
        """Name of the campaign that it is about; empty where it is about none."""
        return "" if self.file.about is None else self.file.about.campaign

    @property
    def state(self) -> str:
        """Label of the state that it is about; empty where it is about none."""
        return "" if self.file.about is None else self.file.about.state or ""

    @property
    def step_px(self) -> int:
        """Every how many pixels maps are sampled."""
        return step_of(self.size, SAMPLES)

    @property
    def view(self) -> str:
        """The view that it is about; empty where it is about none, or several."""
        return "" if self.file.about is None else self.file.about.view or ""

    @property
    def camera(self) -> str:
        """The camera over whose image its fields are."""
        return view_of(self.view).camera if self.view else self.part


def drawing_script() -> str:
    """Return the script that draws fields, in reports as in the console."""
    from sms_jobs.formats.drawing import assets

    return assets.drawing_script()


def drawing_style() -> str:
    """Return the style of what `drawing_script` makes."""
    from sms_jobs.formats.drawing import assets

    return assets.drawing_style()


@use_case(Right.READ)
def field_page(services: Services, key: str, part: str | None = None) -> FieldPage:
    """Return what can be shown of the fields of a file, without reading any.

    Parameters
    ----------
    part
        Which of several groups of records, as C1 of a merged result; the first if it is None.

    Raises
    ------
    NotFound
        There is no such file, or it has no such part.
    InvalidInput
        It has no fields over an image.
    """
    fields = fields_of(services, key, part)
    file = fields.file
    alike: list[SimilarResult] = []
    reruns: list[Rerun] = []
    turn, shift = np.eye(3), np.zeros(3)
    with services.catalogue.reading() as session:
        statistics = search.statistics(session, file.id)
        if (about := file.about) is not None:
            campaign = campaigns.definition(campaigns.campaign_row(session, about.campaign))
            found = search.find_files(session, source=file.source, campaign=about.campaign, limit=_MOST_FILES)
            alike = _alike(file, found, campaign)
            reruns = _reruns(session, file, found)
            if fields.position is not None:
                placement = campaign.placement
                turn, shift = placement.matrix().T, np.array(placement.translation)
    return FieldPage(
        file,
        fields.part,
        fields.parts,
        fields.placed[0].size,
        tuple(_quantity(one, file) for one in fields.placed),
        fields.position,
        fields.movement,
        tuple(alike),
        tuple(reruns),
        tuple(map(float, turn.ravel())),
        tuple(map(float, shift)),
        statistics,
    )


def _quantity(one: Placed, file: FileView) -> Quantity:
    shown, own = one.shown, one.file == file
    return Quantity(
        shown.name,
        shown.unit,
        shown.sigma is not None,
        shown.flags,
        shown.record if own and shown.array else None,
        shown.array if own else None,
        shown.component,
        shown.scale,
    )


def _alike(file: FileView, found: Iterable[FileView], campaign: Campaign) -> list[SimilarResult]:
    """Return the newest of each state and view, but this one of its own, in the order of the states."""
    newest = {file.subject: file}
    for one in found:
        if one.media_type == file.media_type:
            newest.setdefault(one.subject, one)
    places = {state.label: place for place, state in enumerate(campaign.states)}
    subjects = [(Subject.parse(one.subject), one.id) for one in newest.values()]
    ordered = sorted(
        (places[about.state], about.view or "", number) for about, number in subjects if about.state in places
    )
    states = campaign.states
    return [
        SimilarResult(number, states[k].label, view, states[k].known_load_n) for k, view, number in ordered
    ]


def _reruns(session: Session, file: FileView, found: Iterable[FileView]) -> list[Rerun]:
    """Return the other results about the same, and the parameters in which they differ from this one."""
    others = [
        one
        for one in found
        if one.subject == file.subject and one.media_type == file.media_type and one.id != file.id
    ]
    known = search.parameters(session, [file.id, *(one.id for one in others)])
    own = known.get(file.id, {})
    return [
        Rerun(
            one.id,
            one.created_at,
            {name: value for name, value in known.get(one.id, own).items() if own.get(name) != value},
        )
        for one in others
    ]
