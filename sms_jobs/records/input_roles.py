"""Under which role a job keeps an input; no other module knows how one is written.

It is the name of the port at which the input comes in, and what it is about where that port has several.
"""

from __future__ import annotations

from sms_jobs.records.subject import Subject


def role_at(port: str, about: Subject | None = None) -> str:
    """Return the role of an input at a port; of one of several, that of what is about a subject."""
    return port if about is None else f"{port} {about}"


def port_of(role: str) -> str:
    """Return the name of the port at which an input of a role comes in."""
    return role.partition(" ")[0]
