"""Files of the archive as they are shown: found, with their values, and with what they come from."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sms_jobs.errors import InvalidInput
from sms_jobs.records.input_roles import port_of
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import is_view, view_of


@dataclass(frozen=True)
class FileView:
    """One file as it is shown."""

    id: int
    source: str
    subject: str
    path: str
    content_hash: str
    size_bytes: int
    sha256: str
    media_type: str
    created_at: datetime
    recorded_at: datetime | None
    job_id: str | None

    @property
    def about(self) -> Subject | None:
        """What it is about; None of a calibration, which is a rig's."""
        return Subject.parse(self.subject) if self.subject else None

    def in_campaign(self) -> Subject:
        """Return what it is about; raise `InvalidInput` where that is no part of a campaign."""
        if self.about is None:
            raise InvalidInput(
                f"file {self.id} ({self.source}) is of no campaign; choose a measurement or a result"
            )
        return self.about

    @property
    def in_plane(self) -> bool:
        """Whether it is about what a camera alone saw."""
        view = "" if self.about is None else self.about.view or ""
        return is_view(view) and not view_of(view).measures_shape


@dataclass(frozen=True)
class Found:
    """A file, and what was asked about it, in the units of the question; None where it has no such value."""

    file: FileView
    values: dict[str, float | str | datetime | None]


@dataclass(frozen=True)
class Page:
    """Some of the files that meet a query, the newest first.

    Attributes
    ----------
    columns
        Names of the values, in the order of the question.
    next
        What to go on after to get the next page; None on the last one.
    """

    columns: tuple[str, ...]
    rows: tuple[Found, ...]
    next: int | None


@dataclass(frozen=True)
class Ancestor:
    """A file in a provenance tree, and what it was to the file above it in the tree, or that one to it.

    In a tree of what was computed from a file, `inputs` are what was computed from this one. `told` says that
    the same file stands elsewhere in the tree with its inputs, which are left out here: a calibration is an
    input of everything, and has hundreds of its own. `more` says that the tree ends here and its inputs are
    not all in it.
    """

    role: str
    file: FileView
    inputs: tuple[Ancestor, ...]
    repeated: bool
    more: bool

    @property
    def port(self) -> str:
        """Name of the port at which it came in."""
        return port_of(self.role)


@dataclass(frozen=True)
class Family:
    """The tree below a file; `more` as of an `Ancestor`."""

    inputs: tuple[Ancestor, ...]
    more: bool


@dataclass(frozen=True)
class DecisionView:
    """The last decision about a calibration for its rig, or for one campaign.

    Attributes
    ----------
    at
        When it was made.
    campaign
        For which it was; None for the rig.
    in_use
        Whether it is used.
    by, reason
        Who has decided it, and why; empty where nobody has a name, or gave none.
    """

    at: datetime
    campaign: str | None
    in_use: bool
    by: str
    reason: str


@dataclass(frozen=True)
class CalibrationView:
    """One calibration as it is shown."""

    id: int
    rig: str
    valid_from: datetime | None
    """None where nobody knows when its session was."""
    origin: str
    sensors: tuple[str, ...]
    path: str
    content_hash: str
    size_bytes: int
    sha256: str
    in_use: bool
    """For its rig: all campaigns that have no calibration of their own."""
    campaigns: tuple[str, ...]
    """That it is used for alone."""

    @property
    def inactive(self) -> bool:
        """Whether nothing is computed with it."""
        return not self.in_use and not self.campaigns
