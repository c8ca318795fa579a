"""From what a person asks for to the graph of jobs that gives it."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from typing import TYPE_CHECKING, Any

from sms_jobs.errors import InvalidInput, NotFound, SmsError
from sms_jobs.kinds import all_kinds, kind_named
from sms_jobs.kinds.kind import (
    CALIBRATION,
    MEASUREMENT,
    REFERENCE_SURFACES,
    Kind,
    Need,
    Scope,
    default_subjects,
    pipeline_subjects,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign

PIPELINE = "pipeline"


@dataclass(frozen=True)
class Request:
    """A kind, or the whole pipeline, with parameters, for some or all states and views of a campaign.

    Attributes
    ----------
    kind
        Name of a kind, or `PIPELINE`.
    parameters
        By name; for the pipeline, by `kind.name`.
    states, views
        Empty for all.
    priority
        By how much its jobs come before the others of their submission.
    """

    kind: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    states: tuple[str, ...] = ()
    views: tuple[str, ...] = ()
    priority: int = 0


def given_parameters(requests: Iterable[Request]) -> dict[str, Any]:
    """Return the values of parameters that requests give, by `kind.name`."""
    return {
        name if request.kind == PIPELINE else f"{request.kind}.{name}": value
        for request in requests
        for name, value in request.parameters.items()
    }


@dataclass(frozen=True)
class Existing:
    """What meets a need already: a file of the archive, or a job on its way to making one."""

    file_id: int | None = None
    job_id: str | None = None


@dataclass(frozen=True)
class PlannedInput:
    """An input of a planned job: something that exists, or the planned job that will make it."""

    need: Need
    existing: Existing | None
    producer: int | None


@dataclass(frozen=True)
class PlannedJob:
    """One job of a plan; producers are places in the plan, always before the job itself."""

    kind: Kind[Any]
    subject: Subject
    parameters: Parameters
    inputs: tuple[PlannedInput, ...]
    priority: int = 0


@dataclass(frozen=True)
class Refused:
    """A state that is left out of a plan with all its jobs, or a job of a whole campaign, and why.

    Attributes
    ----------
    subject
        The state, as campaign/state, or the campaign.
    error
        Why: what the first of its jobs lacks.
    jobs
        How many of its jobs are left out, by kind.
    """

    subject: Subject
    error: SmsError
    jobs: Mapping[str, int]


@dataclass(frozen=True)
class Plan:
    """The jobs that can be planned, each after those it needs, and what cannot be."""

    jobs: tuple[PlannedJob, ...]
    refused: tuple[Refused, ...]


_Key = tuple[str, Subject]


@dataclass
class _Node:
    """A job on its way into a plan: its inputs, each with the job that makes it or what exists of it."""

    inputs: list[tuple[Need, _Key | None, Existing | None]] = field(default_factory=list)
    error: SmsError | None = None

    @property
    def producers(self) -> tuple[_Key, ...]:
        return tuple(dict.fromkeys(producer for _, producer, _ in self.inputs if producer is not None))


def plan(
    campaign: Campaign, requests: Sequence[Request], find: Callable[[Need], Existing | None]
) -> tuple[PlannedJob, ...]:
    """Expand requests into jobs, each after the jobs whose results it needs: all of them, or none.

    Raises as `plan_possible` does, and for each state that cannot be planned.
    """
    found = plan_possible(campaign, requests, find)
    if found.refused:
        raise found.refused[0].error
    return found.jobs


def plan_possible(
    campaign: Campaign, requests: Sequence[Request], find: Callable[[Need], Existing | None]
) -> Plan:
    """Expand requests into jobs, each after the jobs whose results it needs, for the states that allow it.

    A state one of whose jobs lacks something is refused as a whole, and so is what needs its results.

    Parameters
    ----------
    campaign
        What the jobs are about.
    requests
        What was asked for.
    find
        Finds what meets a need already, if there is anything.

    Raises
    ------
    InvalidInput
        A kind, parameter, state or view does not exist, a kind can do nothing in this campaign, or its jobs
        cover what a state or view would be a part of.
    NotFound
        Every job that was asked for would need a result that neither exists nor is part of the plan.
    """
    requested = _expand(campaign, requests)
    parameters = {
        name: one.kind.checked_parameters({**campaign.processing.get(name, {}), **one.request.parameters})
        for name, one in requested.items()
    }
    asked = {(name, subject): None for name, one in requested.items() for subject in _selected(one)}
    nodes = _connected(campaign, requested, parameters, asked, find)
    refused = _refused(nodes)
    wanted = [key for key in asked if key not in refused]
    if refused and not wanted:
        raise next(iter(refused.values()))
    # What only refused jobs would have needed is left out with them.
    kept, pending = dict.fromkeys(wanted), deque(wanted)
    while pending:
        new = [one for one in nodes[pending.popleft()].producers if one not in kept]
        kept.update(dict.fromkeys(new))
        pending.extend(new)
    order = _ordered({key: nodes[key].producers for key in nodes if key in kept})
    place = {key: i for i, key in enumerate(order)}
    jobs = tuple(
        PlannedJob(
            requested[name].kind,
            subject,
            parameters[name],
            tuple(
                PlannedInput(need, existing, None if producer is None else place[producer])
                for need, producer, existing in nodes[name, subject].inputs
            ),
            requested[name].request.priority,
        )
        for name, subject in order
    )
    return Plan(jobs, _told(refused))


def _connected(
    campaign: Campaign,
    requested: Mapping[str, _Requested],
    parameters: Mapping[str, Parameters],
    asked: Mapping[_Key, None],
    find: Callable[[Need], Existing | None],
) -> dict[_Key, _Node]:
    """Return the jobs that were asked for and those that they need, with what is to be had for each."""
    # A kind that has nothing to do in this campaign makes nothing that others could wait for.
    makers = {one.kind.makes or name: one.kind for name, one in requested.items() if one.subjects}
    # What cannot be asked for twice is made where it was asked for and nowhere else.
    once = {name for name, one in requested.items() if not one.kind.repeatable(parameters[name])}
    # A requested kind also makes what the other jobs need of it, e.g. the reference state's shape.
    nodes, pending = {key: _Node() for key in asked}, deque(asked)

    def connect(node: _Node, name: str, subject: Subject) -> None:
        kind = requested[name].kind
        for need in kind.checked_needs(campaign, subject, parameters[name]):
            # What is needed of another campaign must be there: this plan is not about it.
            maker = makers.get(need.source) if need.subject.campaign == campaign.name else None
            producer = None if maker is None else (maker.name, covering(maker, need.subject))
            if producer is not None and producer[0] in once and producer not in asked:
                producer = None
            existing = None if producer is not None else _existing(campaign, need, find, kind, subject)
            node.inputs.append((need, producer, existing))

    while pending:
        key = pending.popleft()
        try:
            connect(nodes[key], *key)
        except (InvalidInput, NotFound) as error:
            nodes[key].error = error
        for producer in nodes[key].producers:
            if producer not in nodes:
                nodes[producer] = _Node()
                pending.append(producer)
    return nodes


def _refused(nodes: Mapping[_Key, _Node]) -> dict[_Key, SmsError]:
    """Return the jobs that cannot be planned, with the error behind each: those that lack something first.

    With a job all others of its state are refused, and with those what needs their results.
    """
    refused = {key: node.error for key, node in nodes.items() if node.error is not None}
    dependents: dict[_Key, list[_Key]] = {}
    of_state: dict[str, list[_Key]] = {}
    for key, node in nodes.items():
        for producer in node.producers:
            dependents.setdefault(producer, []).append(key)
        if key[1].state is not None:
            of_state.setdefault(key[1].state, []).append(key)
    pending = deque(refused)
    while pending:
        key = pending.popleft()
        for other in (*of_state.pop(key[1].state or "", ()), *dependents.get(key, ())):
            if other not in refused:
                refused[other] = refused[key]
                pending.append(other)
    return refused


def _told(refused: Mapping[_Key, SmsError]) -> tuple[Refused, ...]:
    """Return what is refused by states, and the kinds of the whole campaign each by itself."""
    by_place: dict[tuple[Subject, str], list[_Key]] = {}
    for key in refused:
        subject = replace(key[1], view=None)
        by_place.setdefault((subject, "" if subject.state is not None else key[0]), []).append(key)
    return tuple(
        Refused(subject, refused[keys[0]], Counter(name for name, _ in keys))
        for (subject, _), keys in by_place.items()
    )


@dataclass(frozen=True)
class _Requested:
    """A kind that was asked for, how, and all its subjects in the campaign."""

    kind: Kind[Any]
    request: Request
    subjects: tuple[Subject, ...]


def _expand(campaign: Campaign, requests: Sequence[Request]) -> dict[str, _Requested]:
    """Return what was asked for by name of kind, the pipeline as those of its kinds that can do something."""
    requested: dict[str, _Requested] = {}
    pipeline = {name: pipeline_subjects(kind, campaign) for name, kind in all_kinds().items()}
    pipeline = {name: subjects for name, subjects in pipeline.items() if subjects}
    for request in requests:
        _check_places(campaign, request)
        if request.kind != PIPELINE:
            kind = kind_named(request.kind)
            subjects = default_subjects(kind, campaign)
            # Beside the pipeline, which does what can be done, the same holds for the others.
            if not subjects and all(other.kind != PIPELINE for other in requests):
                raise InvalidInput(_cannot(kind, campaign, pipeline))
            requested[request.kind] = _Requested(kind, request, subjects)
            continue
        kinds = {name: kind_named(name) for name in pipeline}
        by_kind = _by_kind(request.parameters, kinds)
        for name, kind in kinds.items():
            # A part of a campaign has no report of the whole, and one of its views nothing that is merged.
            if _cut_by(kind, campaign, request, campaign.measured_views):
                continue
            own = replace(request, kind=name, parameters=by_kind.get(name, {}))
            requested[name] = _Requested(kind, own, pipeline[name])
    for request in requests:
        if request.kind != PIPELINE:
            _refuse_cut(requested[request.kind], campaign, requested.values())
    return requested


def _check_places(campaign: Campaign, request: Request) -> None:
    for label in request.states:
        campaign.state(label)
    unknown = set(request.views) - set(campaign.views)
    if unknown:
        raise InvalidInput(
            f"campaign {campaign.name} has no view {', '.join(sorted(unknown))}; "
            f"it has {', '.join(campaign.views)}"
        )


def _cut_by(kind: Kind[Any], campaign: Campaign, request: Request, views: Iterable[str]) -> str:
    """Return what chooses a part of what one job of a kind covers, which is `views` of a state; or ""."""
    labels = {state.label for state in campaign.states}
    if kind.scope is Scope.CAMPAIGN and request.states and not labels.issubset(request.states):
        return "state"
    if kind.scope is not Scope.TUPLE and request.views and not set(views).issubset(request.views):
        return "view"
    return ""


def _refuse_cut(one: _Requested, campaign: Campaign, requested: Iterable[_Requested]) -> None:
    """Refuse to choose a part of what a job covers, unless what is chosen is made of its result."""
    kind, request = one.kind, one.request
    cut_by = _cut_by(kind, campaign, request, campaign.views)
    chosen = [o.kind for o in requested if not _cut_by(o.kind, campaign, o.request, campaign.views)]
    needed = {port.source for other in chosen for port in other.inputs}
    if not cut_by or (kind.makes or kind.name) in needed:
        return
    covered = f"campaign {campaign.name}"
    if cut_by == "view" and kind.scope is Scope.STATE:
        covered = f"a state of {covered}"
    further = f", or {kind.of_some_states}" if cut_by == "state" and kind.of_some_states else ""
    raise InvalidInput(
        f"a job of {kind.name} is about all {cut_by}s of {covered}, so that choosing some of them by "
        f"`{cut_by}` has no effect on it: submit {kind.name} without it{further}"
    )


def _cannot(kind: Kind[Any], campaign: Campaign, others: Iterable[str]) -> str:
    """Say that a kind has no subject in a campaign, with what may be why, and what has one."""
    count = len(campaign.states)
    return (
        f"{kind.name} has nothing to do in campaign {campaign.name}, which has {count} "
        f"{'state' if count == 1 else 'states'} measured by {', '.join(campaign.views)}"
        f"{'' if campaign.shows_fringes else ' without a projector'}; "
        f"its pipeline is {', '.join(others) or 'empty'}"
    )


def _by_kind(parameters: Mapping[str, Any], kinds: Mapping[str, Kind[Any]]) -> dict[str, dict[str, Any]]:
    split: dict[str, dict[str, Any]] = {}
    for name, value in parameters.items():
        kind, dot, parameter = name.partition(".")
        if not dot or kind not in kinds:
            raise InvalidInput(
                f"parameter '{name}' of the pipeline must be KIND.NAME=VALUE, "
                f"with KIND one of {', '.join(kinds)}"
            )
        split.setdefault(kind, {})[parameter] = value
    return split


def _selected(requested: _Requested) -> list[Subject]:
    states, views = requested.request.states, requested.request.views
    return [
        subject
        for subject in requested.subjects
        if (not states or subject.state is None or subject.state in states)
        and (not views or subject.view is None or subject.view in views)
    ]


def _existing(
    campaign: Campaign, need: Need, find: Callable[[Need], Existing | None], kind: Kind[Any], subject: Subject
) -> Existing:
    existing = find(need)
    if existing is None:
        who = f"{kind.name} {subject}"
        if need.source == CALIBRATION:
            raise NotFound(
                f"{who} needs a calibration of rig {campaign.rig} that is valid when it was measured, and "
                f"there is none; bring one in with 'sms calibration import FILE --rig {campaign.rig}', or "
                "certify one that was measured"
            )
        ways = ", or ".join(filter(None, [_way_to(campaign, need), kind.otherwise(campaign, need)]))
        raise NotFound(f"{who} needs the {need.source} of {need.subject}, and there is none; {ways}")
    return existing


def _way_to(campaign: Campaign, need: Need) -> str:
    if need.source == REFERENCE_SURFACES:
        return f"bring one in with 'sms import surface FILE -c {need.subject.campaign}'"
    if need.source == MEASUREMENT:
        return "record or simulate it, or bring it in with 'sms import'"
    kind = kind_named(need.source)
    made = covering(kind, need.subject)
    # Of another campaign nothing is known here but its name.
    if made in default_subjects(kind, campaign) and made not in pipeline_subjects(kind, campaign):
        others = (
            f", or set `view` to views other than {made.view}" if made.view and campaign.views[1:] else ""
        )
        return (
            f"the pipeline does not make it: submit {kind.name} as well, as in "
            f"'sms job submit {kind.name} -c {campaign.name}'{others}"
        )
    return "submit the pipeline, or the job that makes it first"


def covering(kind: Kind[Any], subject: Subject) -> Subject:
    """Return the subject of the job of a kind whose outputs include one about `subject`."""
    if kind.scope is Scope.CAMPAIGN:
        return Subject(subject.campaign)
    return replace(subject, view=None) if kind.scope is Scope.STATE else subject


def _ordered(producers: Mapping[_Key, Sequence[_Key]]) -> list[_Key]:
    try:
        return list(TopologicalSorter(producers).static_order())
    except CycleError as error:
        raise InvalidInput("the requested kinds need each other's results in a circle") from error
