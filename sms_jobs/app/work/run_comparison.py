"""What differs between two runs: how they were computed, and what came out, in numbers and as a page."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import groupby
from math import sqrt
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray
from sqlalchemy.orm import Session

from sms_jobs.app.fields.field_sources import Placed, fields_of, read
from sms_jobs.app.progress import Step, Tell, nobody
from sms_jobs.app.row_tables import write_csv
from sms_jobs.app.rules import use_case
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns, search
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.asking import run_changes, runs
from sms_jobs.jobs.asking.runs import Member, Members
from sms_jobs.kinds.products import GAUGES
from sms_jobs.metrology.deformation.fields.changes import Change, change_of, sigma_of_difference
from sms_jobs.records.job import SHORT_ID
from sms_jobs.records.people import Right
from sms_jobs.records.shown.runs import Difference, RunComparison, RunResult
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    from sms_jobs.formats.report.view import Field, View

_FIELDS = {"correlate": "displacement", "strain": "strain"}
"""The array of fields that is subtracted, by kind."""
_GAUGES = "gauges"
_MAP_PX = 320
_FINE_RESULTS = 120
"""Results of which a page has maps of `_MAP_PX` samples along the longer side; of more, coarser ones."""
_LEAST_PX = 64
_STILL_PX = 420
_MICROSTRAIN = 1e6


@use_case(Right.READ)
def compare_runs(services: Services, before: str, after: str, *, tell: Tell = nobody) -> RunComparison:
    """Say what was not the same in two runs, and by how much their results differ, after minus before.

    Displacement and strain are subtracted pixel by pixel of the reference image, gauges one by one.

    Raises
    ------
    InvalidInput
        They are one run, or have no result of the same kind and subject.
    NotFound
        There is no such run.
    ArchiveCorrupt
        A result is not what was sealed.
    """
    return _compared(services, before, after, tell, lambda one: None)


@dataclass(frozen=True)
class ComparedPage:
    """What differs between two runs, and a page about it as HTML."""

    comparison: RunComparison
    html: str


@use_case(Right.READ)
def compare_runs_page(services: Services, before: str, after: str, *, tell: Tell = nobody) -> ComparedPage:
    """Compare two runs as `compare_runs` does, with maps of the differences over the states as a page."""
    from sms_jobs.formats.report.run_differences import StateMaps, runs_page

    shown: list[_Subtracted] = []
    found = _compared(services, before, after, tell, shown.append, maps=True)
    states = [
        StateMaps(str(state), tuple(_views(some)))
        for state, some in groupby(shown, lambda one: Subject.parse(one.subject).at_state)
    ]
    return ComparedPage(found, runs_page(found, states))


def table(found: RunComparison) -> str:
    """Return the differences as CSV, with units in a column of their own."""
    names = [field.name for field in fields(Difference) if field.name != "files"]
    text = io.StringIO()
    columns = [*names, "file_before", "file_after"]
    rows = ([*(getattr(one, name) for name in names), *one.files] for one in found.differences)
    write_csv(text, columns, rows)
    return text.getvalue()


@dataclass(frozen=True)
class _Subtracted:
    """Two results of one kind and subject, subtracted."""

    subject: str
    differences: tuple[Difference, ...]
    size: tuple[int, int] = (0, 0)
    step_px: int = 1
    fields: tuple[Field, ...] = ()


class _Unlike(Exception):
    """Why two results cannot be subtracted."""


def _compared(
    services: Services,
    before: str,
    after: str,
    tell: Tell,
    show: Callable[[_Subtracted], None],
    *,
    maps: bool = False,
) -> RunComparison:
    if before == after:
        raise InvalidInput(f"'{before}' is compared with itself; give the names of two runs")
    with services.catalogue.reading() as session:
        ours, theirs = runs.members(session, before), runs.members(session, after)
        order = _order(session, ours)
    changes, pairs = run_changes.changes(ours, theirs), run_changes.pairs(ours, theirs)
    if not pairs:
        raise InvalidInput(
            f"runs '{before}' and '{after}' have no result of the same kind and subject; "
            f"'sms run show' lists the results of each"
        )
    numbered = sorted((p for p in pairs if p[0].result.kind in (*_FIELDS, _GAUGES)), key=order)
    other = [pair for pair in numbered if not _are_same(*pair)]
    map_px = _map_px(sum(pair[0].result.kind in _FIELDS for pair in other)) if maps else 0
    differences: list[Difference] = []
    unlike: list[str] = []
    for place, (mine, its) in enumerate(other):
        about = f"{mine.result.kind} {mine.result.subject}"
        tell(Step("comparing", place, len(other), about))
        try:
            subtracted = _subtracted(services, mine, its, map_px)
        except _Unlike as why:
            unlike.append(f"{about}: {why}")
            continue
        differences += subtracted.differences
        show(subtracted)
    tell(Step("comparing", len(other), len(other)))
    return RunComparison(
        before,
        after,
        changes,
        tuple(differences),
        len(numbered) - len(other),
        run_changes.alone(ours, theirs),
        run_changes.alone(theirs, ours),
        tuple(unlike),
    )


def _order(session: Session, run: Members) -> Callable[[tuple[Member, Member]], Any]:
    """Return what sorts pairs by campaign, state as they were planned, view and kind."""
    about = {Subject.parse(subject).campaign for _, subject in run.by_subject}
    places = {
        (name, state.label): place
        for name in about
        for place, state in enumerate(campaigns.definition(campaigns.campaign_row(session, name)).states)
    }

    def key(pair: tuple[Member, Member]) -> Any:
        own = Subject.parse(pair[0].result.subject)
        return (
            own.campaign,
            places.get((own.campaign, own.state or ""), -1),
            own.view or "",
            pair[0].result.kind,
        )

    return key


def _are_same(mine: Member, other: Member) -> bool:
    """Return whether two results are one, or of one content; of what was removed nobody knows the content."""
    return mine.result.made_by == other.result.made_by or (
        bool(mine.contents) and mine.contents == other.contents
    )


def _map_px(results: int) -> int:
    """Return how finely maps are sampled for all of them to fit into a page."""
    return max(_LEAST_PX, min(_MAP_PX, int(_MAP_PX * sqrt(_FINE_RESULTS / max(results, 1)))))


def _subtracted(services: Services, mine: Member, other: Member, map_px: int) -> _Subtracted:
    """Subtract two results; raise `_Unlike` where that says nothing."""
    files = (_dataset(mine), _dataset(other))
    if mine.result.kind == _GAUGES:
        return _gauges(services, mine.result.subject, files)
    return _fields(services, mine.result, files, map_px)


def _dataset(member: Member) -> int:
    numbers = zip(member.result.files, member.media_types, strict=True)
    found = next((number for number, kind in numbers if kind == DATASET_MEDIA_TYPE), None)
    if found is None:
        raise _Unlike(f"the result of job {member.result.made_by[:SHORT_ID]} was removed by a policy")
    return found


def _fields(services: Services, result: RunResult, files: tuple[int, int], map_px: int) -> _Subtracted:
    from sms_jobs.formats.report.view import Sampler

    array = _FIELDS[result.kind]
    before, after = (_placed(services, number, array) for number in files)
    if not before or [_alike(one) for one in before] != [_alike(one) for one in after]:
        raise _Unlike(f"{_told(before)} before, {_told(after)} after")
    size = before[0].size
    sampler = Sampler(size, map_px or max(size), _STILL_PX)
    differences: list[Difference] = []
    drawn: list[Field] = []
    for one, another in zip(before, after, strict=True):
        (old, old_sigma), (new, new_sigma) = _values(services, one), _values(services, another)
        sigma = None
        if old_sigma is not None and new_sigma is not None:
            sigma = sigma_of_difference(old_sigma, new_sigma)
        change, difference = change_of(old, new, sigma)
        differences.append(_difference(result.subject, one.shown.name, one.shown.unit, files, change))
        if map_px:
            name = f"change of {one.shown.name}"
            drawn.append(sampler.field(name, one.shown.unit, difference, sigma, still=not drawn))
    return _Subtracted(result.subject, tuple(differences), size, sampler.step_px, tuple(drawn))


def _placed(services: Services, number: int, array: str) -> list[Placed]:
    """Return the components of a field that a file has itself."""
    own = fields_of(services, str(number)).placed
    return [
        p for p in own if p.file.id == number and p.shown.array == array and p.shown.component is not None
    ]


def _alike(one: Placed) -> tuple[str, str, tuple[int, int]]:
    return one.shown.name, one.shown.unit, one.size


def _told(some: Sequence[Placed]) -> str:
    """Say over what, and in which unit, a field is."""
    if not some:
        return "no field"
    return (
        f"{len(some)} components [{some[0].shown.unit or '1'}] over {some[0].size[1]} x {some[0].size[0]} px"
    )


def _values(services: Services, one: Placed) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Return a quantity over the whole image, and its standard deviation."""
    readings = [reading for reading in (one.shown.values, one.shown.sigma) if reading is not None]
    rows, columns = one.size
    values, *sigma = read(services.archive, one, readings, slice(0, rows, 1), slice(0, columns, 1))
    return values, sigma[0] if sigma else None


def _difference(subject: str, quantity: str, unit: str, files: tuple[int, int], change: Change) -> Difference:
    return Difference(subject, quantity, unit, files, **asdict(change))


def _gauges(services: Services, subject: str, files: tuple[int, int]) -> _Subtracted:
    """Subtract what gauges of the same name read."""
    before, after = (_read_gauges(services, number) for number in files)
    names = [name for name in before if name in after]
    if not names:
        raise _Unlike(f"gauges {', '.join(before)} before, {', '.join(after)} after")
    differences = []
    for name in names:
        (old, old_sigma), (new, new_sigma) = before[name], after[name]
        change, _ = change_of(old, new, sigma_of_difference(old_sigma, new_sigma))
        differences.append(_difference(subject, f"gauge {name}", "µε", files, change))
    return _Subtracted(subject, tuple(differences))


def _read_gauges(services: Services, number: int) -> dict[str, tuple[NDArray[Any], NDArray[Any]]]:
    """Return strain and standard deviation of each gauge in microstrain, (1,) each."""
    with services.catalogue.reading() as session:
        file = search.file_view(session, str(number))
    with services.archive.open(file) as dataset:
        found = GAUGES.read(dataset)
    strain, sigma = _MICROSTRAIN * found.strain, _MICROSTRAIN * found.sigma
    return {name: (strain[k : k + 1], sigma[k : k + 1]) for k, name in enumerate(found.names)}


def _views(some: Iterable[_Subtracted]) -> Iterator[View]:
    """Yield a view for each subject, with what of its fields has one size."""
    from sms_jobs.formats.report.view import View

    with_maps = (one for one in some if one.fields)
    for (subject, size), results in groupby(with_maps, lambda one: (one.subject, one.size)):
        found = list(results)
        view = Subject.parse(subject).view or ""
        drawn = tuple(field for one in found for field in one.fields)
        yield View(f"Changes as {view} sees them", view, size, found[0].step_px, drawn)
