"""What can be computed: the job kinds and their parameters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.jobs.planning.graph import PIPELINE
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.documents import Document
from sms_jobs.kinds.kind import Kind, Port
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from sms_jobs.kinds.products import Product

EVERYTHING = PIPELINE
"""Instead of a kind: all that lead from measurements to the report."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a kind; None is the default of one that has to be given, too.

    Attributes
    ----------
    choices
        The words that it may be; empty where it is no choice among words.
    """

    name: str
    default: Any
    meaning: str
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class TakenRecord:
    """A record that is read at a port, its class, and the sources whose files may have it."""

    name: str
    record: str
    sources: tuple[str, ...]


@dataclass(frozen=True)
class PortView:
    """What comes in at a port of a kind.

    Attributes
    ----------
    sources
        What makes it, one of these for each subject: kinds, or what no kind alone makes.
    several
        Whether a job has one for each of several subjects.
    """

    name: str
    sources: tuple[str, ...]
    several: bool
    records: tuple[TakenRecord, ...]


@dataclass(frozen=True)
class OutputView:
    """What a kind gives: a record of a result, or a document.

    Attributes
    ----------
    record
        The class of a record; None of a document.
    media_type
        Of a document; None of a record.
    key
        What tells several of the name apart, as a camera; empty where a result has one.
    """

    name: str
    record: str | None
    media_type: str | None
    key: str


@dataclass(frozen=True)
class KindView:
    """A job kind.

    Attributes
    ----------
    name, version, summary
        Which it is, and what it does.
    per
        What one job of it is for: a tuple, a state or a campaign.
    inputs, outputs
        What it takes at its ports, each of them once, and what it gives: records, then documents.
    parameters
        In the order in which they are declared.
    """

    name: str
    version: int
    per: str
    summary: str
    inputs: tuple[PortView, ...]
    outputs: tuple[OutputView, ...]
    parameters: tuple[Parameter, ...]


def kinds() -> list[KindView]:
    """Return the job kinds, in the order in which results follow from each other."""
    return [_view(kind) for kind in all_kinds().values()]


@use_case(Right.READ)
def list_kinds(_services: Services) -> list[KindView]:
    """Return the job kinds, in the order in which results follow from each other."""
    return kinds()


def find_kind(name: str) -> KindView | None:
    """Return the kind of a name; None where there is none."""
    kind = all_kinds().get(name)
    return None if kind is None else _view(kind)


def _view(kind: Kind[Any]) -> KindView:
    return KindView(
        kind.name,
        kind.version,
        kind.scope.value,
        kind.summary,
        tuple(_ports(kind.inputs)),
        tuple(map(_output, kind.outputs)),
        tuple(
            Parameter(
                name,
                None if field.is_required() else field.get_default(call_default_factory=True),
                field.description or "",
                _choices(field.annotation),
            )
            for name, field in kind.parameters.model_fields.items()
        ),
    )


def _ports(ports: Iterable[Port]) -> Iterator[PortView]:
    """Yield the ports of a kind, those of one name that several makers feed as one."""
    named: dict[str, list[Port]] = {}
    for port in ports:
        named.setdefault(port.name, []).append(port)
    for name, fed in named.items():
        makers: dict[Product[Any], list[str]] = {}
        for port in fed:
            for product in port.products:
                makers.setdefault(product, []).append(port.source)
        yield PortView(
            name,
            tuple(port.source for port in fed),
            any(port.several for port in fed),
            tuple(TakenRecord(p.name, p.record.__name__, tuple(made)) for p, made in makers.items()),
        )


def _output(one: Product[Any] | Document) -> OutputView:
    if isinstance(one, Document):
        return OutputView(one.name, None, one.media_type, one.keyed_by)
    return OutputView(one.name, one.record.__name__, None, one.keyed_by)


def _choices(annotation: Any) -> tuple[str, ...]:
    return tuple(map(str, get_args(annotation))) if get_origin(annotation) is Literal else ()
