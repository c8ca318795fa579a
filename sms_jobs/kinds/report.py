"""Report: one page for people about a whole campaign, made of results that exist already."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from pydantic import Field

from sms_jobs.formats.report import html
from sms_jobs.formats.report.html import Cell, Markup, Section
from sms_jobs.formats.report.maps import MERGED_HEADER, STRAIN_HEADER, Draughtsman, merged_row, strain_row
from sms_jobs.formats.report.tables import accuracy, campaign_facts, load_states, local_time
from sms_jobs.kinds.kind import (
    CALIBRATION,
    MEASUREMENT,
    Dataset,
    DocumentOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Parameters,
    Progress,
    Scope,
    tuples,
)
from sms_jobs.records.assessment import Assessment
from sms_jobs.records.campaign import Campaign, LoadState, Subject
from sms_jobs.records.fields import MergedField, PointCloud, Regions, StrainField
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Calibration, split_pair

_PICTURES_OF_A_STATE = 4
_INTRODUCTION = (
    "Lengths are in millimetres in the frame of the calibration, strains in microstrain (µε) in the "
    "plane of the surface. Grey in a map means that nothing could be measured there. Standard deviations "
    "cover the camera's noise, not the calibration. Where a camera has several projectors and a map is of "
    "one pair, it is of the pair that sees most of the surface."
)


class ReportParameters(Parameters):
    """How large the page may become."""

    figure_width_px: int = Field(420, ge=240, le=1600, description="width of every picture in pixels")
    most_figures: int = Field(
        100, ge=4, le=1000, description="most pictures; with more states, maps of some are left out"
    )


class Origin(Protocol):
    """How a file of the archive came about."""

    @property
    def kind(self) -> str:
        """Name of the kind that made it."""
        ...

    @property
    def kind_version(self) -> int:
        """Version of that kind."""
        ...

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Of that kind, as JSON."""
        ...

    @property
    def created_at(self) -> datetime:
        """When it was made."""
        ...

    @property
    def program_version(self) -> str:
        """Version of this program."""
        ...

    @property
    def host(self) -> str:
        """Name of the computer."""
        ...

    @property
    def operator(self) -> str:
        """Name of the person."""
        ...


@runtime_checkable
class Traceable(Protocol):
    """A dataset that tells where it comes from, as those of the archive do."""

    @property
    def path(self) -> str:
        """Of the file in the archive."""
        ...

    @property
    def content_hash(self) -> str:
        """Of what it says."""
        ...

    @property
    def provenance(self) -> Origin:
        """How it came about."""
        ...


def pairs_by_camera(campaign: Campaign) -> dict[str, tuple[str, ...]]:
    """Return the pairs of every camera, in the campaign's order."""
    pairs: dict[str, tuple[str, ...]] = {}
    for pair in campaign.pairs:
        camera = split_pair(pair)[0]
        pairs[camera] = (*pairs.get(camera, ()), pair)
    return pairs


def shown_states(campaign: Campaign, most_figures: int) -> tuple[LoadState, ...]:
    """Return the deformed states whose maps are shown: evenly spread over the test, with the last."""
    deformed = campaign.states[1:]
    room = max(1, most_figures // (_PICTURES_OF_A_STATE * max(1, len(pairs_by_camera(campaign)))))
    if len(deformed) <= room:
        return deformed
    places = np.linspace(len(deformed) - 1, 0, room).round().astype(int)
    return tuple(deformed[place] for place in sorted(places))


def _role(source: str, state: str, pair: str = "") -> str:
    return "/".join(part for part in (source, state, pair) if part)


def needs(campaign: Campaign, subject: Subject) -> Iterable[Need]:
    """Return everything that the page shows; errors where the truth is known."""
    reference = campaign.reference.label
    yield Need("calibration", CALIBRATION, Subject(campaign.name))
    for each in tuples(campaign):
        state, pair = each.state or "", each.pair or ""
        if state == reference:
            yield Need(_role(MEASUREMENT, state, pair), MEASUREMENT, each)
            yield Need(_role("reconstruct", state, pair), "reconstruct", each)
        else:
            yield Need(_role("strain", state, pair), "strain", each)
        if len(campaign.states) > 1 and state == campaign.states[1].label:
            yield Need(_role("correlate", state, pair), "correlate", each)
        if campaign.scene is not None:
            yield Need(_role("assess", state, pair), "assess", each)
    for loaded in campaign.states[1:]:
        yield Need(_role("merge", loaded.label), "merge", Subject(campaign.name, loaded.label))


def whole_campaign(campaign: Campaign, subject: Subject) -> Campaign:
    """Say that the page depends on the whole definition of the campaign."""
    return campaign


@dataclass(frozen=True)
class _Rows:
    """The tables that grow while the states are drawn."""

    merged: list[list[Cell]] = field(default_factory=list)
    strain: list[list[Cell]] = field(default_factory=list)


def run(inputs: Inputs, parameters: ReportParameters, progress: Progress) -> Iterator[Output]:
    """Make the page: records are read one at a time, and only small pictures and numbers of them are kept."""
    campaign: Campaign = inputs.context
    draw = Draughtsman(parameters.figure_width_px)
    best = _best_pairs(inputs, campaign)
    at_rest, recorded = _reference_section(inputs, campaign, best, draw)
    progress(0.1, "drew the reference state")
    rows = _Rows()
    states: list[Section] = []
    drawn = shown_states(campaign, parameters.most_figures)
    for place, state in enumerate(campaign.states[1:]):
        states.append(_state_section(inputs, state, best, draw if state in drawn else None, rows))
        progress(0.1 + 0.7 * (place + 1) / len(campaign.states), f"drew state {state.label}")
    overview = [campaign_facts(campaign), load_states(campaign.states, recorded)]
    sections = [Section("Load states", overview), at_rest]
    if states:
        sections += [_results_section(campaign, drawn, rows), *(s for s in states if s.content)]
    if campaign.scene is not None:
        sections.append(_accuracy_section(inputs, campaign))
    sections.append(Section("Where this comes from", _origins(inputs.datasets)))
    document = html.page(f"Campaign {campaign.name}", [html.paragraph(_INTRODUCTION, faint=True)], sections)
    progress(1.0, "wrote the page")
    yield DocumentOutput(inputs.subject, f"{campaign.name}-report.html", "text/html", page_writer(document))


def _best_pairs(inputs: Inputs, campaign: Campaign) -> dict[str, str]:
    """Return, by camera, the pair that sees most of the surface at the reference state."""
    label = campaign.reference.label
    best: dict[str, str] = {}
    for camera, pairs in pairs_by_camera(campaign).items():
        seen: dict[str, int] = {}
        for pair in pairs:
            cloud = inputs.read(_role("reconstruct", label, pair), "cloud", PointCloud)
            seen[pair] = int(np.count_nonzero(cloud.reason == Reason.VALID))
            del cloud
        best[camera] = max(pairs, key=lambda pair: seen[pair])
    return best


def page_writer(document: str) -> Callable[[Path], None]:
    """Return what writes a page into a file."""

    def write(path: Path) -> None:
        path.write_text(document, encoding="utf-8")

    return write


def _reference_section(
    inputs: Inputs, campaign: Campaign, best: Mapping[str, str], draw: Draughtsman
) -> tuple[Section, Mapping[str, datetime]]:
    """Draw the reference state of each camera; also return when it was recorded."""
    label = campaign.reference.label
    views: list[Markup] = []
    recorded: dict[str, datetime] = {}
    for camera, pair in best.items():
        where = f"{camera} ({pair}, {label})"
        measurement = inputs.read(_role(MEASUREMENT, label, pair), "measurement", Measurement)
        recorded.setdefault(label, measurement.recorded_at)
        regions = None
        if len(campaign.states) > 1:
            found = _role("correlate", campaign.states[1].label, pair)
            regions = inputs.read(found, "regions", Regions)
        texture = draw.texture(measurement, regions, where)
        cloud = inputs.read(_role("reconstruct", label, pair), "cloud", PointCloud)
        views.append(html.figures([texture, draw.depth(cloud, where), draw.depth_sigma(cloud, where)]))
    return Section(f"Reference state {label}", views), recorded


def _state_section(
    inputs: Inputs, state: LoadState, best: Mapping[str, str], draw: Draughtsman | None, rows: _Rows
) -> Section:
    """Add a state's numbers to the tables and, with someone to draw, return its maps."""
    pictures: dict[str, list[Markup]] = {camera: [] for camera in best}
    merge = _role("merge", state.label)
    for camera in best:
        merged = inputs.read(merge, camera, MergedField)
        rows.merged.append(merged_row(merged, state.label))
        if draw is not None:
            pictures[camera] += draw.displacement(merged, f"{camera} ({state.label})")
        del merged
    for pair in inputs.context.pairs:
        camera = split_pair(pair)[0]
        strain = inputs.read(_role("strain", state.label, pair), "strain", StrainField)
        rows.strain.append(strain_row(strain, state.label, pair))
        if draw is not None and best[camera] == pair:
            pictures[camera] += draw.strain(strain, f"{camera} ({pair}, {state.label})")
        del strain
    load = "" if state.load_n is None else f", {html.number(html.Given(state.load_n))} N"
    views = [html.figures(camera) for camera in pictures.values() if camera]
    return Section(f"State {state.label}{load}", views, level=3)


def _results_section(campaign: Campaign, drawn: tuple[LoadState, ...], rows: _Rows) -> Section:
    content = [
        Markup("<h3>Displacement, by camera</h3>"),
        html.table(MERGED_HEADER, rows.merged),
        Markup("<h3>Strain, by pair</h3>"),
        html.table(STRAIN_HEADER, rows.strain),
    ]
    count = len(campaign.states) - 1
    if len(drawn) < count:
        content.append(html.paragraph(f"Maps are shown of {len(drawn)} of the {count} deformed states."))
    return Section("Displacement and strain", content)


def _accuracy_section(inputs: Inputs, campaign: Campaign) -> Section:
    """List measured minus true of every tuple."""
    diagonal = inputs.read("calibration", "calibration", Calibration).volume.diagonal_mm
    found: dict[tuple[str, str], Assessment] = {}
    for each in tuples(campaign):
        state, pair = each.state or "", each.pair or ""
        assessment = inputs.read(_role("assess", state, pair), "assessment", Assessment)
        found[(state, pair)] = _without_images(assessment)
    words = html.paragraph(
        "The rig is virtual, so the truth is known: errors are measured minus true over all valid pixels, "
        "nothing trimmed. An error over its predicted standard deviation is 1 for an honest prediction. The "
        f"diagonal of the measurement volume is {html.number(diagonal)} mm."
    )
    return Section("Accuracy", [words, *accuracy(found, diagonal)])


def _without_images(assessment: Assessment) -> Assessment:
    """Keep the numbers of an assessment and let go of its images."""
    nothing = np.empty((0, 0), np.float32)
    return Assessment(assessment.shape, assessment.displacement, assessment.strain, nothing)


def _origins(datasets: Mapping[str, Dataset]) -> list[Markup]:
    """List every file that the page was made of."""
    rows: list[list[Cell]] = []
    for role, dataset in datasets.items():
        if not isinstance(dataset, Traceable):
            rows.append([role, str(dataset.subject), None, None, None, None, None])
            continue
        made = dataset.provenance
        settings = json.dumps(dict(made.parameters), ensure_ascii=False)
        rows.append(
            [
                role,
                html.code(dataset.path),
                f"{made.kind}, version {made.kind_version}",
                html.folded("show", html.code(settings)) if made.parameters else None,
                f"{local_time(made.created_at)}, {made.operator} on {made.host}",
                made.program_version,
                html.code(dataset.content_hash[:16], title=dataset.content_hash),
            ]
        )
    header = ["used as", "file", "made by", "parameters", "when and by whom", "program", "content hash"]
    return [html.table(header, rows)]


KIND = Kind(
    name="report",
    summary="write one page about a campaign: states, maps, uncertainties, errors and origins",
    version=1,
    scope=Scope.CAMPAIGN,
    parameters=ReportParameters,
    needs=needs,
    run=run,
    context=whole_campaign,
)
