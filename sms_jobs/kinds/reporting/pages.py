"""Writes the pages of a report: state by state, view by view, with nothing but numbers kept of them."""

from __future__ import annotations

import io
import zipfile
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
from sms_jobs.formats.report.maps import view_markup
from sms_jobs.formats.report.origins import origin_sections
from sms_jobs.formats.report.page import Page, Part, Section
from sms_jobs.formats.report.tables import accuracy, campaign_facts, load_states
from sms_jobs.formats.report.view import View
from sms_jobs.kinds import defaults_of_kinds
from sms_jobs.kinds.kind import Inputs, Progress, tested_states, tuples
from sms_jobs.kinds.products import ASSESSMENT, CALIBRATED, MEASURED, QUALITY, RECORDED
from sms_jobs.kinds.reporting.chapter import (
    ASSESSMENTS,
    CALIBRATION_SHOWN,
    RECORDINGS,
    Chapter,
    Sampling,
    present,
)
from sms_jobs.records.assessment import Assessment
from sms_jobs.records.calibration import CalibrationQuality
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.recording import Recording, as_recorded, mean_readings
from sms_jobs.records.subject import Subject

_INTRODUCTION = (
    "Grey in a map means that nothing could be measured there. Standard deviations are one sigma, without a "
    "coverage factor. What a map tells under the pointer is the archive's value at a sampled pixel, rounded "
    "to about an eighth of its standard deviation; the whole field is given by sms data export."
)


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
    shown
        The deformed states whose maps are in the page itself.
    progress
        Told after each state.
    """

    def __init__(
        self,
        inputs: Inputs,
        campaign: Campaign,
        sampling: Sampling,
        shown: Sequence[LoadState],
        progress: Progress,
    ) -> None:
        self._inputs = inputs
        self._campaign = replace(campaign, states=_as_recorded(inputs, campaign))
        self._sampling = sampling
        self._shown = {state.label for state in shown}
        self._progress = progress
        self._chapters = present(self._campaign)
        self._deformed = tested_states(self._campaign)[1:]
        self._drawn = 0

    def write_page(self, path: Path) -> None:
        """Write the page about the whole campaign."""
        with Part() as rest, Part() as states, path.open("w", encoding="utf-8", newline="\n") as out:
            at_rest = {c.name: self._reference(c, rest) for c in self._chapters}
            self._progress(0.1, "drew the reference state")
            over = {c.name: Followed(self._followed_places(c)) for c in self._chapters}
            for place, state in enumerate(self._deformed):
                self._state(state, over, states if state.label in self._shown else None)
                self._progress(0.1 + 0.4 * (place + 1) / len(self._deformed), f"read state {state.label}")
            self._compose(out, at_rest, over, rest, states)

    def write_states(self, path: Path) -> None:
        """Write a ZIP file with a page of every deformed state, and a page that leads to them."""
        # Numbered, as the names of two states may differ in case alone, or one be called index.
        names = {s.label: f"{place:03}-{s.label}.html" for place, s in enumerate(self._deformed, start=1)}
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as folder:
            with _text_file(folder, "index.html") as out:
                self._index(out, names)
            for place, state in enumerate(self._deformed):
                with _text_file(folder, names[state.label]) as out:
                    self._state_page(out, place, names)
                self._progress(
                    0.5 + 0.49 * (place + 1) / len(self._deformed), f"wrote the page of {state.label}"
                )

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

    def _state(self, state: LoadState, over: Mapping[str, Followed], part: Part | None) -> None:
        """Read a state: its numbers into the tables, its views into a part."""
        sampling = self._sampling if part is not None else Sampling(self._sampling.map_px, 0)
        if part is not None:
            part.add(
                Markup(
                    f'<h3 id="state-{escape(state.label)}">{escape(_heading(state))}</h3><div class="views">'
                )
            )
        for chapter in self._chapters:
            for view in chapter.deformed(self._inputs, self._campaign, state, sampling):
                over[chapter.name].add(state.label, view)
                if part is not None:
                    self._write(view, state.label, part)
                del view
        if part is not None:
            part.add(Markup("</div>"))

    def _write(self, view: View, state: str, part: Part, level: int = 4) -> None:
        self._drawn += 1
        part.add(*view_markup(view, self._drawn, state, self._sampling.still_px, level))

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
        page.section(Section("Load states", overview))
        for name, followed in chapters.items():
            found = followed.charts()
            drawn = [charts(found, along)] if found else []
            page.section(Section(name, [*drawn, *followed.tables()]))
        page.section(Section(reference, [t for f in at_rest.values() for t in f.tables()]))
        page.copy(rest)
        if self._deformed:
            page.section(Section(maps, self._left_out()))
            page.copy(states)
        for section in closing:
            page.section(section)
        page.end()

    def _introduction(self) -> list[Markup]:
        words = " ".join([*(c.introduction for c in self._chapters), _INTRODUCTION])
        warnings = tuple(certificate.doubts_of(self._quality, self._recordings))
        return [html.paragraph(words, faint=True), *certificate.doubts(warnings)]

    def _left_out(self) -> list[Markup]:
        count = len(self._deformed)
        if len(self._shown) == count:
            return []
        words = f"Maps are shown of {len(self._shown)} of the {count} deformed states."
        return [html.paragraph(f"{words} A ZIP file beside this page has a page of each.")]

    def _closing(self) -> list[Section]:
        found: list[Section] = []
        if self._inputs.about(ASSESSMENTS):
            found.append(self._accuracy())
        if self._inputs.has(CALIBRATION_SHOWN):
            calibration = self._inputs.read(CALIBRATION_SHOWN, CALIBRATED)
            found.append(Section("Calibration", certificate.calibration_summary(calibration, self._quality)))
        if self._recordings:
            found.append(Section("Recordings", certificate.recordings(self._recordings)))
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
        return {str(subject): recording for subject, recording in _recordings(self._inputs)}

    def _recorded_at(self) -> Mapping[str, datetime]:
        """Return when the reference state was recorded; the others say so themselves."""
        label = self._campaign.reference.label
        for view in self._campaign.recordings:
            own = Subject(self._campaign.name, label, view)
            if self._inputs.has(RECORDINGS, about=own):
                return {label: self._inputs.read(RECORDINGS, MEASURED, own).recorded_at}
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

    def _index(self, out: TextIO, names: Mapping[str, str]) -> None:
        page = Page(out, f"Campaign {self._campaign.name}: states", [])
        links = "".join(
            f'<li><a href="{escape(names[state.label])}">{escape(_heading(state))}</a></li>\n'
            for state in self._deformed
        )
        page.add(
            load_states(tested_states(self._campaign), self._recorded_at()), Markup(f"<ul>\n{links}</ul>")
        )
        page.end()

    def _state_page(self, out: TextIO, place: int, names: Mapping[str, str]) -> None:
        state = self._deformed[place]
        links = [("index.html", "all states")]
        for there, words in ((place - 1, "before"), (place + 1, "after")):
            if 0 <= there < len(self._deformed):
                label = self._deformed[there].label
                links.append((names[label], f"state {words}: {label}"))
        line = " ".join(f'<a href="{escape(to)}">{escape(words)}</a>' for to, words in links)
        over = {c.name: Followed(()) for c in self._chapters}
        with Part() as part:
            self._state(state, over, part)
            about = [*self._introduction(), Markup(f'<nav aria-label="States">{line}</nav>')]
            page = Page(out, f"Campaign {self._campaign.name}: {_heading(state)}", about)
            page.add(*(table for f in over.values() for table in f.tables()))
            page.copy(part)
            page.end()


def _heading(state: LoadState) -> str:
    load = "" if state.known_load_n is None else f", {html.number(html.Given(state.known_load_n))} N"
    return f"State {state.label}{load}"


def _recordings(inputs: Inputs) -> Iterator[tuple[Subject, Recording]]:
    """Yield what instruments said of the recordings that they made, with the tuple of each."""
    for subject in inputs.about(RECORDINGS):
        if inputs.has(RECORDINGS, RECORDED, subject):
            yield subject, inputs.read(RECORDINGS, RECORDED, subject)


def _as_recorded(inputs: Inputs, campaign: Campaign) -> tuple[LoadState, ...]:
    """Return the states of a campaign with what was read while they were recorded."""
    read: dict[str | None, list[dict[str, float]]] = {}
    for subject, recording in _recordings(inputs):
        read.setdefault(subject.state, []).append(recording.readings())
    return tuple(as_recorded(s, mean_readings(read.get(s.label, []))) for s in campaign.states)


def _text_file(folder: zipfile.ZipFile, name: str) -> TextIO:
    """Open a new file in a ZIP file, without its time: the same pages have the same bytes."""
    entry = zipfile.ZipInfo(name)
    entry.compress_type = zipfile.ZIP_DEFLATED
    return io.TextIOWrapper(folder.open(entry, "w", force_zip64=True), encoding="utf-8", newline="\n")


def _without_images(assessment: Assessment) -> Assessment:
    """Keep the numbers of an assessment and let go of its images."""
    nothing = np.empty((0, 0), np.float32)
    return Assessment(assessment.shape, assessment.displacement, assessment.strain, nothing)
