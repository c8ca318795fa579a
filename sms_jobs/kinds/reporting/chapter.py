"""What a report consists of: chapters, each a module of this package with a `CHAPTER`, found by itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from sms_jobs.discovery import declared
from sms_jobs.formats.report.view import Sampler, View
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, Inputs, Need, Port
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

CALIBRATION_SHOWN = Port("calibration", CALIBRATION, (CALIBRATED, QUALITY))
RECORDINGS = Port("measurement", MEASUREMENT, (MEASURED, RECORDED), several=True)
SURFACES = surface_port("shape", several=True)
DISPLACEMENTS = Port("displacement", "correlate", (REGIONS,), several=True)
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


def chapters() -> tuple[Chapter, ...]:
    """Return every chapter that there is, in order."""
    return tuple(sorted(declared("sms_jobs.kinds", "CHAPTER").values(), key=lambda c: (c.rank, c.name)))


def present(campaign: Campaign) -> tuple[Chapter, ...]:
    """Return the chapters about what is measured in a campaign."""
    return tuple(c for c in chapters() if next(iter(c.needs(campaign)), None) is not None)
