"""What the service promises, tried: a module here that has a `PROMISE` is found by itself.

Each module tries one promise the hard way, with real processes and files, and yields what came of it as
figures of the group `promises`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from sms_jobs.bench.figures import Found, Run
from sms_jobs.discovery import declared


@dataclass(frozen=True)
class Promise:
    """One promise and how it is tried.

    Attributes
    ----------
    name
        Of the module's subject, by which promises are ordered.
    measure
        Tries it, and yields figures and the conditions under which they hold.
    """

    name: str
    measure: Callable[[Run], Iterator[Found]]


def all_promises() -> dict[str, Promise]:
    """Return every promise by name."""
    return declared(__name__, "PROMISE")
