"""Writes the pages of a report: state by state, view by view, with nothing but numbers kept of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TextIO

import numpy as np

from sms_jobs.formats.report import certificate, html
from sms_jobs.formats.report.charts import axes, axes_block, charts
from sms_jobs.formats.report.following import Followed, Place, places
from sms_jobs.formats.report.html import Markup
from sms_jobs.formats.report.maps import Held, view_markup
from sms_jobs.formats.report.origins import origin_sections
from sms_jobs.formats.report.page import Page, Part, Section
from sms_jobs.formats.report.tables import accuracy, campaign_facts, load_states
from sms_jobs.formats.report.view import View, thinned
from sms_jobs.kinds import defaults_of_kinds
from sms_jobs.kinds.kind import Inputs, Progress, tested_states, tuples
from sms_jobs.kinds.products import ASSESSMENT, CALIBRATED, MEASURED, QUALITY
from sms_jobs.kinds.reporting.chapter import (
    ASSESSMENTS,
    CALIBRATION_SHOWN,
    RECORDINGS,
    Chapter,
    Sampling,
    as_recorded_in,
    closings,
    present,
    recordings,
)
from sms_jobs.records.assessment import Assessment
from sms_jobs.records.calibration import CalibrationQuality
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.recording import Recording
from sms_jobs.records.subject import Subject
from sms_jobs.records.times import UNTIMED

_INTRODUCTION = (
    "Grey in a map means that nothing could be measured there. Standard deviations are one sigma, without a "
    "coverage factor. What a map tells under the pointer is the archive's value at a sampled pixel, rounded "
    "to steps that it names, of about a twelfth of its standard deviation; the whole field is given by sms "
    "data export."
)
LEAST_MAP_PX = 64
_FEW = 12
"""States that are tried as they are wanted, without a look at how much room they take."""
_ROOM = 0.9
"""Part of a page that maps may take; pictures, charts and tables have the rest."""
_HALVED = 3
"""How often maps are made half as fine, to see how much room they take."""
_AGAIN = 0.95, 0.6
"""Of a page that is too large: samples of the next try are this factor over this power of the excess."""


class ReportPages:
    """The pages about one campaign.

    Parameters
    ----------
    inputs
        Of the job.
    campaign
        What they are about.
    sampling
        How finely images are shown.
    pictured
        The deformed states of which there are still pictures.
    progress
        Told after each state.
    most_bytes
        Largest size of the page: maps are sampled more coarsely until it fits.
    left_out
        Labels of the states of which the page says that it does not show them.
    """

    def __init__(
        self,
        inputs: Inputs,
        campaign: Campaign,
        sampling: Sampling,
        pictured: Sequence[LoadState],
        progress: Progress,
        most_bytes: float = math.inf,
        left_out: Sequence[str] = (),
    ) -> None:
        self._inputs = inputs
        self._planned = campaign
        self._campaign = as_recorded_in(inputs, campaign)
        self._sampling = sampling
        self._pictured = {state.label for state in pictured}
        self._progress, self._told = progress, 0.0
        self._most_bytes, self._left_out = most_bytes, left_out
        self._chapters = present(self._campaign)
        self._deformed = tested_states(self._campaign)[1:]
        self._drawn = 0
        self._held = Held()
        self._coarser = False
        self._pitches: dict[str, tuple[int, float | None]] = {}

    def write_page(self, path: Path) -> None:
        """Write the page about the whole campaign, as finely as its size allows."""
        wanted, map_px = self._sampling, self._fitting_px()
        while True:
            self._coarser = map_px < wanted.map_px
            self._sampling = replace(wanted, map_px=map_px)
            self._drawn, self._held = 0, Held()
            self._write_once(path)
            excess = path.stat().st_size / self._most_bytes
            if excess <= 1.0 or map_px <= LEAST_MAP_PX:
                return
            factor, power = _AGAIN
            map_px = max(LEAST_MAP_PX, int(factor * map_px / excess**power))

    def _tell(self, part: float, words: str) -> None:
        """Tell how far it is; a page that is written again does not go back."""
        self._told = max(self._told, part)
        self._progress(self._told, words)

    def _fitting_px(self) -> int:
        """Return how many samples along the longer side leave the page its size, from states of all ages."""
        wanted, count = self._sampling.map_px, len(self._deformed)
        if count <= _FEW or math.isinf(self._most_bytes):
            return wanted
        most = _ROOM * self._most_bytes / count
        tried = (self._deformed[place] for place in {0, count // 2, count - 1})
        fitting = min(self._fitting_state(state, most) for state in tried)
        return int(min(wanted, max(LEAST_MAP_PX, fitting)))

    def _fitting_state(self, state: LoadState, most: float) -> float:
        """Return how many samples along the longer side make the maps of a state take `most` bytes."""
        sizes, longest = np.zeros(_HALVED + 1), 0
        for view in self._views(state, replace(self._sampling, still_px=0)):
            longest = max(longest, *view.fields[0].values.shape)
            for place in range(len(sizes)):
                sizes[place] += _size(view, state.label)
                view = thinned(view)
        if most >= sizes[0]:
            return math.inf
        # Between pitches that were tried, bytes go with a power of the pitch.
        halved = np.interp(math.log(most), np.log(sizes[::-1]), np.arange(len(sizes))[::-1])
        return float(longest / 2.0**halved)

    def _views(self, state: LoadState, sampling: Sampling) -> Iterator[View]:
        """Yield what all chapters show of a deformed state."""
        for chapter in self._chapters:
            yield from chapter.deformed(self._inputs, self._campaign, state, sampling)

    def _write_once(self, path: Path) -> None:
        with Part() as rest, Part() as states, path.open("w", encoding="utf-8", newline="\n") as out:
            at_rest = {c.name: self._reference(c, rest) for c in self._chapters}
            self._tell(0.1, "drew the reference state")
            over = {c.name: Followed(self._followed_places(c)) for c in self._chapters}
            for place, state in enumerate(self._deformed):
                self._state(state, over, states)
                self._tell(0.1 + 0.8 * (place + 1) / len(self._deformed), f"drew state {state.label}")
            self._compose(out, at_rest, over, rest, states)

    def _reference(self, chapter: Chapter, part: Part) -> Followed:
        """Write the views of the reference state into a part, and return their numbers."""
        found = Followed(())
        label = self._campaign.reference.label
        part.add(Markup('<div class="views">'))
        for view in chapter.reference(self._inputs, self._campaign, self._sampling):
            found.add(label, view)
            self._write(view, label, part, level=3)
            del view
        part.add(Markup("</div>"))
        return found

    def _followed_places(self, chapter: Chapter) -> tuple[Place, ...]:
        """Return where fields are followed: where they are large at the last state."""
        if not self._deformed:
            return ()
        bare = Sampling(self._sampling.map_px, 0)
        last = chapter.deformed(self._inputs, self._campaign, self._deformed[-1], bare)
        return tuple(place for view in last for place in places(view))

    def _state(self, state: LoadState, over: Mapping[str, Followed], part: Part) -> None:
        """Write the views of a state into a part, and its numbers into the tables."""
        pictured = state.label in self._pictured
        sampling = self._sampling if pictured else replace(self._sampling, still_px=0)
        kind = "state" if pictured else "state unpictured"
        part.add(
            Markup(
                f'<div class="{kind}" id="state-{escape(state.label)}">'
                f'<h3>{escape(_heading(state))}</h3><div class="views">'
            )
        )
        for chapter in self._chapters:
            for view in chapter.deformed(self._inputs, self._campaign, state, sampling):
                over[chapter.name].add(state.label, view)
                self._pitches[view.key] = (view.step_px, view.pitch_mm)
                self._write(view, state.label, part)
                del view
        part.add(Markup("</div></div>"))

    def _write(self, view: View, state: str, part: Part, level: int = 4) -> None:
        self._drawn += 1
        part.add(*view_markup(view, self._drawn, state, self._sampling.still_px, self._held, level))

    def _compose(
        self,
        out: TextIO,
        at_rest: Mapping[str, Followed],
        over: Mapping[str, Followed],
        rest: Part,
        states: Part,
    ) -> None:
        campaign = self._campaign
        chapters = {c.name: over[c.name] for c in self._chapters} if self._deformed else {}
        maps = "Maps of the deformed states"
        reference = f"Reference state {campaign.reference.label}"
        closing = self._closing()
        contents = [
            "Load states",
            *chapters,
            reference,
            *([maps] if self._deformed else []),
            *(s.title for s in closing),
        ]
        page = Page(out, f"Campaign {campaign.name}", self._introduction(), contents)
        along = axes(tested_states(campaign))
        page.add(axes_block(along))
        overview = [campaign_facts(campaign), load_states(tested_states(campaign), self._recorded_at())]
        if self._left_out:
            overview.append(html.paragraph(f"Left out, as was asked for: {', '.join(self._left_out)}."))
        page.section(Section("Load states", overview))
        for name, followed in chapters.items():
            found = followed.charts()
            drawn = [charts(found, along)] if found else []
            page.section(Section(name, [*drawn, *followed.tables()]))
        page.section(Section(reference, [t for f in at_rest.values() for t in f.tables()]))
        page.copy(rest)
        if self._deformed:
            page.section(Section(maps, self._about_maps()))
            page.copy(states)
        for section in closing:
            page.section(section)
        page.end()

    def _introduction(self) -> list[Markup]:
        words = " ".join([*(c.introduction for c in self._chapters), _INTRODUCTION])
        warnings = tuple(certificate.doubts_of(self._quality, self._recordings))
        return [html.paragraph(words, faint=True), *certificate.doubts(warnings)]

    def _about_maps(self) -> list[Markup]:
        """Say how finely maps are sampled, why, and where the rest is."""
        count, pictured = len(self._deformed), len(self._pictured)
        apart = "; ".join(
            f"{key}: every {step} px" + ("" if pitch is None else f", {html.number(pitch)} mm on the surface")
            for key, (step, pitch) in self._pitches.items()
        )
        words = f"Maps are samples of the images ({apart})."
        if self._coarser:
            words += (
                f" They are coarser than could be, for all {count} states to be in one page of at most "
                f"{self._most_bytes / 1e6:g} MB; sms job submit report-state gives a page of one state with "
                "finer maps, sms data export the whole fields."
            )
        if pictured < count:
            words += f" Still pictures, for print, are of {pictured} of the {count} deformed states."
        return [html.paragraph(words, faint=True)]

    def _closing(self) -> list[Section]:
        found: list[Section] = []
        if self._inputs.about(ASSESSMENTS):
            found.append(self._accuracy())
        if self._inputs.has(CALIBRATION_SHOWN):
            calibration = self._inputs.read(CALIBRATION_SHOWN, CALIBRATED)
            found.append(Section("Calibration", certificate.calibration_summary(calibration, self._quality)))
        if self._recordings:
            found.append(Section("Recordings", certificate.recordings(self._recordings)))
        found += [closing.section(self._inputs, self._planned) for closing in closings()]
        last = origin_sections(self._inputs.datasets, self._campaign.name, defaults_of_kinds())
        return [*found, *last]

    @cached_property
    def _quality(self) -> CalibrationQuality | None:
        if not self._inputs.has(CALIBRATION_SHOWN, QUALITY):
            return None
        return self._inputs.read(CALIBRATION_SHOWN, QUALITY)

    @cached_property
    def _recordings(self) -> Mapping[str, Recording]:
        """Return what instruments said of the recordings that they made, by tuple."""
        return {str(subject): recording for subject, recording in recordings(self._inputs)}

    def _recorded_at(self) -> Mapping[str, datetime]:
        """Return when the reference state was recorded, where that is known; the others say so themselves."""
        label = self._campaign.reference.label
        for view in self._campaign.recordings:
            own = Subject(self._campaign.name, label, view)
            if self._inputs.has(RECORDINGS, about=own):
                at = self._inputs.read(RECORDINGS, MEASURED, own).recorded_at
                return {} if at == UNTIMED else {label: at}
        return {}

    def _accuracy(self) -> Section:
        """List measured minus true of every tuple."""
        diagonal = self._inputs.read(CALIBRATION_SHOWN, CALIBRATED).volume.diagonal_mm
        found: dict[tuple[str, str], Assessment] = {}
        for each in tuples(self._campaign):
            assessment = self._inputs.read(ASSESSMENTS, ASSESSMENT, each)
            found[each.state or "", each.view or ""] = _without_images(assessment)
        words = html.paragraph(
            "The rig is virtual, so the truth is known: errors are measured minus true over all valid "
            "pixels, nothing trimmed. An error over its predicted standard deviation is 1 for an honest "
            f"prediction. The diagonal of the measurement volume is {html.number(diagonal)} mm."
        )
        return Section("Accuracy", [words, *accuracy(found, diagonal)])


def _size(view: View, state: str) -> int:
    """Return how many bytes the maps of a view take in a page that has its positions already."""
    held = Held()
    for _ in range(2):
        size = sum(len(piece.html) for piece in view_markup(view, 1, state, 0, held))
    return size


def _heading(state: LoadState) -> str:
    load = "" if state.known_load_n is None else f", {html.number(html.Given(state.known_load_n))} N"
    return f"State {state.label}{load}"


def _without_images(assessment: Assessment) -> Assessment:
    """Keep the numbers of an assessment and let go of its images."""
    nothing = np.empty((0, 0), np.float32)
    return Assessment(assessment.shape, assessment.displacement, assessment.strain, nothing)
