"""What can be computed: the job kinds and their parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.jobs.planning.graph import PIPELINE
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import Kind
from sms_jobs.records.people import Right

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
class KindView:
    """A job kind.

    Attributes
    ----------
    name, version, summary
        Which it is, and what it does.
    per
        What one job of it is for: a tuple, a state or a campaign.
    inputs, outputs
        What it takes and gives: ports and records, as plain values.
    parameters
        In the order in which they are declared.
    """

    name: str
    version: int
    per: str
    summary: str
    inputs: tuple[dict[str, Any], ...]
    outputs: tuple[dict[str, str], ...]
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
        tuple(port.described() for port in kind.inputs),
        tuple(product.described() for product in kind.outputs),
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


def _choices(annotation: Any) -> tuple[str, ...]:
    return tuple(map(str, get_args(annotation))) if get_origin(annotation) is Literal else ()
