"""What there is of a campaign, by state, view and kind."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cell:
    """What there is of a kind for a state and view.

    Attributes
    ----------
    state, view
        None for a result of the campaign, or of a state, as a whole.
    kind
        Of job, or `measurement`.
    condition
        `measured`, `computed` or `stale`; or the state of the newest job where that has not succeeded.
    file
        Number of the newest file; None where there is none.
    media_type
        Of that file; empty without one.
    job
        The newest job; None where there was none.
    why
        Why a result is stale, or what was wrong with the newest job where that has ended without one: one
        sentence without its full stop. Empty otherwise.
    pictured
        Whether the file has a field over an image, of which there is a small picture.
    """

    state: str | None
    view: str | None
    kind: str
    condition: str
    file: int | None
    media_type: str
    job: str | None
    why: str
    pictured: bool
