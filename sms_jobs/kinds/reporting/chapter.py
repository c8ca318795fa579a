"""What a report consists of: chapters and closing sections, found by themselves.

A module of this package with a `CHAPTER` or a `CLOSING` is one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from sms_jobs.discovery import declared
from sms_jobs.formats.report.page import Section
from sms_jobs.formats.report.view import Sampler, View
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, Inputs, Need, Port
from sms_jobs.kinds.port_names import MOVED, SHAPE
from sms_jobs.kinds.products import (
    ASSESSMENT,
    CALIBRATED,
    GAUGES,
    MEASURED,
    MERGED,
    QUALITY,
    RECORDED,
    REGIONS,
    STRAIN,
)
from sms_jobs.kinds.surface_ports import surface_port
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.recording import Recording, as_recorded, mean_readings
from sms_jobs.records.subject import Subject

CALIBRATION_SHOWN = Port("calibration", CALIBRATION, (CALIBRATED, QUALITY))
RECORDINGS = Port("measurement", MEASUREMENT, (MEASURED, RECORDED), several=True)
SURFACES = surface_port(SHAPE, several=True)
DISPLACEMENTS = Port(MOVED, "correlate", (REGIONS,), several=True)
STRAINS = Port("strain", "strain", (STRAIN,), several=True)
MERGED_STATES = Port("merged", "merge", (MERGED,), several=True)
GAUGES_READ = Port("gauges", "gauges", (GAUGES,), several=True)
ASSESSMENTS = Port("assessment", "assess", (ASSESSMENT,), several=True)
"""What compares with the truth where it is known."""
SHOWN = (
    CALIBRATION_SHOWN,
    RECORDINGS,
    *SURFACES.all,
    DISPLACEMENTS,
    STRAINS,
    MERGED_STATES,
    GAUGES_READ,
    ASSESSMENTS,
)


@dataclass(frozen=True)
class Sampling:
    """How finely a report shows images.

    Attributes
    ----------
    map_px
        Most samples of a map along its longer side.
    still_px
        Width of a printed picture; 0 where none is made.
    """

    map_px: int
    still_px: int

    def of(self, size: tuple[int, ...]) -> Sampler:
        """Return what samples images of (rows, columns)."""
        return Sampler((size[0], size[1]), self.map_px, self.still_px)


@dataclass(frozen=True)
class Chapter:
    """One way to measure a campaign, and how a report shows what it gives.

    Attributes
    ----------
    name
        Of the chapter; the heading of its table.
    rank
        Chapters of lower rank come first.
    introduction
        What the reader has to know: frames, signs, what standard deviations cover.
    needs
        Every input, at one of the ports `SHOWN`; none for a campaign that is not measured in this way.
    reference
        Yields what is shown of the reference state, one view at a time.
    deformed
        Yields what is shown of another state, one view at a time: a view is let go of before the next.
    also
        By name, further inputs that a reader may ask for, of jobs that not everybody runs.
    """

    name: str
    rank: int
    introduction: str
    needs: Callable[[Campaign], Iterable[Need]]
    reference: Callable[[Inputs, Campaign, Sampling], Iterator[View]]
    deformed: Callable[[Inputs, Campaign, LoadState, Sampling], Iterator[View]]
    also: Mapping[str, Callable[[Campaign], Iterable[Need]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Closing:
    """A section towards the end of a report, about the campaign as a whole.

    Attributes
    ----------
    name
        By which it is told from others.
    rank
        Those of lower rank come first.
    section
        Makes it, from what the report shows and the campaign as it was defined.
    """

    name: str
    rank: int
    section: Callable[[Inputs, Campaign], Section]


def closings() -> tuple[Closing, ...]:
    """Return every closing section that there is, in order."""
    return tuple(sorted(declared("sms_jobs.kinds", "CLOSING").values(), key=lambda c: (c.rank, c.name)))


def recordings(inputs: Inputs) -> Iterator[tuple[Subject, Recording]]:
    """Yield what instruments said of the recordings that they made, with the tuple of each."""
    for subject in inputs.about(RECORDINGS):
        if inputs.has(RECORDINGS, RECORDED, subject):
            yield subject, inputs.read(RECORDINGS, RECORDED, subject)


def as_recorded_in(inputs: Inputs, campaign: Campaign) -> Campaign:
    """Return a campaign whose states have what was read while they were recorded."""
    read: dict[str | None, list[dict[str, float]]] = {}
    for subject, recording in recordings(inputs):
        read.setdefault(subject.state, []).append(recording.readings())
    states = tuple(as_recorded(s, mean_readings(read.get(s.label, []))) for s in campaign.states)
    return replace(campaign, states=states)


def chapters() -> tuple[Chapter, ...]:
    """Return every chapter that there is, in order."""
    return tuple(sorted(declared("sms_jobs.kinds", "CHAPTER").values(), key=lambda c: (c.rank, c.name)))


def present(campaign: Campaign) -> tuple[Chapter, ...]:
    """Return the chapters about what is measured in a campaign."""
    return tuple(c for c in chapters() if next(iter(c.needs(campaign)), None) is not None)
