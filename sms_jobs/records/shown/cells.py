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
    """

    state: str | None
    view: str | None
    kind: str
    condition: str
    file: int | None
    media_type: str
    job: str | None
