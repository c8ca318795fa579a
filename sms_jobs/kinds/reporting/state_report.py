"""Report of a state: one page for people about one deformed state alone."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.documents import DocumentOutput
from sms_jobs.kinds.kind import Inputs, Kind, Need, Output, Progress, Scope, every_deformed_state
from sms_jobs.kinds.reporting import report
from sms_jobs.kinds.reporting.chapter import SHOWN, Sampling, present
from sms_jobs.kinds.reporting.pages import ReportPages
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.subject import Subject


def two_states(campaign: Campaign, subject: Subject) -> Campaign:
    """Return the campaign as if it had the reference and this state alone."""
    state = campaign.state(subject.state or "")
    if state == campaign.reference:
        raise InvalidInput(f"{state.label} is the reference state: every report of a state shows it")
    return replace(campaign, states=(campaign.reference, state))


def _subjects(campaign: Campaign) -> Iterable[Subject]:
    return every_deformed_state(campaign) if present(campaign) else ()


def _needs(campaign: Campaign, subject: Subject, parameters: report.PageParameters) -> Iterable[Need]:
    return report.needs(two_states(campaign, subject), subject, parameters)


def run(inputs: Inputs, parameters: report.PageParameters, progress: Progress) -> Iterator[Output]:
    """Write the page of a campaign that has two states."""
    campaign: Campaign = inputs.context
    sampling = Sampling(parameters.map_px, parameters.figure_width_px)
    pages = ReportPages(inputs, campaign, sampling, campaign.states[1:], progress)
    name = f"{inputs.subject.in_filename}-report.html"
    yield DocumentOutput(inputs.subject, report.PAGE, name, pages.write_page)
    progress(1.0, "wrote the report")


KIND = Kind(
    name="report-state",
    summary="write a page about one state: maps to zoom and turn, uncertainties and origins",
    version=6,
    scope=Scope.STATE,
    parameters=report.PageParameters,
    inputs=SHOWN,
    outputs=(report.PAGE,),
    needs=_needs,
    run=run,
    subjects=_subjects,
    context=two_states,
    in_pipeline=False,
)
