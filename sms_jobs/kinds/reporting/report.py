"""Report: pages for people about a whole campaign, made of results that exist already."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, field_validator

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.documents import Document, DocumentOutput
from sms_jobs.kinds.kind import Inputs, Kind, Need, Output, Progress, Scope, tested_states, tuples
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.reporting.chapter import (
    ASSESSMENTS,
    CALIBRATION_SHOWN,
    RECORDINGS,
    SHOWN,
    Sampling,
    chapters,
    present,
)
from sms_jobs.kinds.reporting.pages import ReportPages
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.subject import Subject


def _parted(value: Any) -> Any:
    return value.split(",") if isinstance(value, str) else value


def _each_once(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name.strip() for name in names if name.strip()))


Names = Annotated[tuple[str, ...], BeforeValidator(_parted), AfterValidator(_each_once)]
"""As "a,b" or one by one."""


class PageParameters(Parameters):
    """How finely a report shows images, and what else it shows."""

    map_px: int = Field(
        320, ge=64, le=4096, description="most samples of a map along its longer side, for zoom and values"
    )
    figure_width_px: int = Field(420, ge=240, le=1600, description="width of every printed picture in pixels")
    also: Names = Field(
        (), description="results that not everybody has: gauges, of jobs 'gauges' that have run"
    )

    @field_validator("also")
    @classmethod
    def _known(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        known = sorted({name for chapter in chapters() for name in chapter.also})
        for name in names:
            if name not in known:
                raise ValueError(f"a report has no extra '{name}'; choose among {', '.join(known)}")
        return names


PAGE = Document("report", "text/html")


class ReportParameters(PageParameters):
    """How finely the report shows images, and how large it may be."""

    most_states: int = Field(
        12,
        ge=1,
        le=1000,
        description="deformed states of which there are still pictures, for print; of more, of evenly spread "
        "ones. Maps are of every state",
    )
    most_mb: int = Field(
        60, ge=1, le=2000, description="largest size of the page in MB: maps are sampled more coarsely to fit"
    )
    leave_out: Names = Field(
        (), description="states that are not shown, such as some that could not be measured: S03,S07"
    )


def _without(campaign: Campaign, labels: Iterable[str]) -> Campaign:
    """Return a campaign as if it had not some states."""
    out = [campaign.state(label) for label in labels]
    if campaign.reference in out:
        raise InvalidInput(f"{campaign.reference.label} is the reference state: every report shows it")
    return replace(campaign, states=tuple(state for state in campaign.states if state not in out))


def pictured_states(campaign: Campaign, most: int) -> tuple[LoadState, ...]:
    """Return the deformed states with still pictures: evenly spread over the test, with the last."""
    deformed = tested_states(campaign)[1:]
    if len(deformed) <= most:
        return deformed
    places_of = np.linspace(len(deformed) - 1, 0, most).round().astype(int)
    return tuple(deformed[place] for place in sorted(places_of))


def needs(campaign: Campaign, subject: Subject, parameters: PageParameters) -> Iterable[Need]:
    """Return everything that the report shows, also what was asked for; errors where the truth is known."""
    return dict.fromkeys(_needs(campaign, parameters))


def _needs(campaign: Campaign, parameters: PageParameters) -> Iterable[Need]:
    if campaign.shape_views:
        yield CALIBRATION_SHOWN.of(Subject(campaign.name))
    for state in tested_states(campaign):
        for view in campaign.recordings_at(state.label):
            yield RECORDINGS.of(Subject(campaign.name, state.label, view))
    for chapter in present(campaign):
        yield from chapter.needs(campaign)
        for name in parameters.also:
            yield from chapter.also.get(name, no_further)(campaign)
    if campaign.scene is not None:
        yield from map(ASSESSMENTS.of, tuples(campaign))


def no_further(campaign: Campaign) -> Iterable[Need]:
    """Need nothing: another chapter has it."""
    return ()


def subjects(campaign: Campaign) -> Iterable[Subject]:
    """Return the campaign, where there is anything to show of it."""
    return (Subject(campaign.name),) if tested_states(campaign) and present(campaign) else ()


def _needs_of_shown(campaign: Campaign, subject: Subject, parameters: ReportParameters) -> Iterable[Need]:
    return needs(_without(campaign, parameters.leave_out), subject, parameters)


def _otherwise(campaign: Campaign, need: Need) -> str:
    state = need.subject.state
    return "" if state in (None, campaign.reference.label) else f"leave the state out with leave_out={state}"


def whole_campaign(campaign: Campaign, subject: Subject) -> Campaign:
    """Say that the report depends on the whole definition of the campaign."""
    return campaign


def run(inputs: Inputs, parameters: ReportParameters, progress: Progress) -> Iterator[Output]:
    """Write the page.

    Records are read one at a time while it is written; nothing but numbers is kept of them.
    """
    campaign = _without(inputs.context, parameters.leave_out)
    pictured = pictured_states(campaign, parameters.most_states)
    sampling = Sampling(parameters.map_px, parameters.figure_width_px)
    most_bytes = 1e6 * parameters.most_mb
    pages = ReportPages(inputs, campaign, sampling, pictured, progress, most_bytes, parameters.leave_out)
    yield DocumentOutput(inputs.subject, PAGE, f"{campaign.name}-report.html", pages.write_page)
    progress(1.0, "wrote the report")


KIND = Kind(
    name="report",
    summary="write pages about a campaign: maps to zoom and turn, charts, uncertainties, errors and origins",
    version=8,
    scope=Scope.CAMPAIGN,
    parameters=ReportParameters,
    inputs=SHOWN,
    outputs=(PAGE,),
    needs=_needs_of_shown,
    run=run,
    subjects=subjects,
    context=whole_campaign,
    otherwise=_otherwise,
    of_some_states="leave some out of its pages with leave_out=STATE; report-state is about one state",
)
