"""What a file was made of, by the port at which it came in."""

from __future__ import annotations

from collections.abc import Iterable

from sms_jobs.records.shown.files import Ancestor, FileView


def inputs_at(inputs: Iterable[Ancestor], *ports: str) -> tuple[FileView, ...]:
    """Return the inputs that came in at ports of some names, those of the first port first."""
    given = tuple(inputs)
    return tuple(one.file for port in ports for one in given if one.port == port)
