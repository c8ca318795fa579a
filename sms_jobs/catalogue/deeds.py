"""What the audit is told; apart from the chain that keeps it, which who reads alone does not load."""

from __future__ import annotations

from dataclasses import dataclass

from sms_jobs.records.people import Actor


@dataclass(frozen=True)
class Deed:
    """Something that an actor does and that is kept.

    Attributes
    ----------
    actor
        Who does it.
    action
        Name of the use case, as `jobs.cancel`.
    arguments
        That were given to it, as JSON.
    """

    actor: Actor
    action: str
    arguments: dict[str, object]
