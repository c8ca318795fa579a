"""Whether whoever asks has what is there already (RFC 9110, 13.1.2)."""

from __future__ import annotations


def has_already(unless: str | None, tag: str) -> bool:
    """Return whether a header `If-None-Match` names the entity tag of what is asked for.

    Parameters
    ----------
    unless
        The header; None where there was none.
    tag
        With its quotes, as it is sent.
    """
    if unless is None:
        return False
    return unless.strip() == "*" or tag in [one.strip().removeprefix("W/") for one in unless.split(",")]
