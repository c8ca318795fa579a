"""What a job or a file is about, by name."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

from sms_jobs.errors import InvalidInput
from sms_jobs.records.views import view_of

RESERVED_NAME = "calibrations"
"""The folder of the archive that holds no campaign."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def checked_name(name: str, what: str) -> str:
    """Return `name` when it can stand in a path and in `campaign/state/view`; raise `InvalidInput` if not."""
    if not _NAME.fullmatch(name) or ".." in name:
        raise InvalidInput(
            f"'{name}' cannot be the name of a {what}: use at most 64 of the letters a to z and A to Z, "
            "digits, '.', '_' or '-', beginning with a letter or digit"
        )
    return name


def alike_but_for_case(names: Iterable[str]) -> tuple[str, str] | None:
    """Return the first two names that differ only in case, which many disks take for one file; else None."""
    known: dict[str, str] = {}
    for name in names:
        other = known.setdefault(name.lower(), name)
        if other != name:
            return other, name
    return None


@dataclass(frozen=True)
class Subject:
    """What a job is about: a campaign, one state of it, or one tuple `campaign/state/view`."""

    campaign: str
    state: str | None = None
    view: str | None = None

    def __str__(self) -> str:
        return "/".join(self._parts)

    @classmethod
    def parse(cls, text: str) -> Subject:
        """Read `campaign`, `campaign/state` or `campaign/state/view`."""
        return _parsed(text)

    @property
    def at_state(self) -> Subject:
        """The state that it is about, whoever saw it; the campaign where it is about all of that."""
        return replace(self, view=None)

    def covers(self, other: Subject) -> bool:
        """Say whether another is this one, or a part of it."""
        return other._parts[: len(self._parts)] == self._parts

    @property
    def within(self) -> str:
        """How it is called within its campaign: by its state and view, as `state/view`."""
        return "/".join(self._parts[1:]) or self.campaign

    @property
    def in_filename(self) -> str:
        """How it is written in the name of a file."""
        return "-".join(self._parts)

    @property
    def _parts(self) -> tuple[str, ...]:
        return tuple(part for part in (self.campaign, self.state, self.view) if part is not None)

    @property
    def recordings(self) -> tuple[Subject, ...]:
        """The tuples that are recorded for a tuple: see `View.recordings`."""
        return tuple(replace(self, view=str(view)) for view in view_of(self.view).recordings)


@lru_cache(maxsize=1 << 14)
def _parsed(text: str) -> Subject:
    """Return a subject; pages read those of thousands of jobs, the same ones again and again."""
    parts = text.split("/")
    if not 1 <= len(parts) <= 3:
        raise InvalidInput(f"'{text}' is not campaign/state/view")
    names = [checked_name(p, w) for p, w in zip(parts, ("campaign", "state", "view"), strict=False)]
    return Subject(*names)
