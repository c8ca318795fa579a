"""Export: write the merged mesh of a state, with its values, in formats of other programs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial

from pydantic import Field, field_validator

from sms_jobs.formats.exporters import all_exporters, exporter_named
from sms_jobs.kinds.kind import (
    DocumentOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Parameters,
    Progress,
    Scope,
    deformed_states,
)
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import Mesh


class ExportParameters(Parameters):
    """Which files are written."""

    formats: tuple[str, ...] = Field(
        default_factory=lambda: tuple(all_exporters()),
        min_length=1,
        description="names of the formats to write; all of them by default",
    )

    @field_validator("formats")
    @classmethod
    def _known_and_different(cls, formats: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in formats if name not in all_exporters()]
        if unknown:
            raise ValueError(f"there is no format {unknown[0]}; choose among {', '.join(all_exporters())}")
        return tuple(dict.fromkeys(formats))


def needs(campaign: Campaign, subject: Subject) -> Iterable[Need]:
    """Return the merged result of the state."""
    yield Need("merged", "merge", subject)


def run(inputs: Inputs, parameters: ExportParameters, progress: Progress) -> Iterator[Output]:
    """Write the mesh of a state, one file for each format."""
    mesh = inputs.read("merged", "mesh", Mesh)
    name = "-".join(part for part in (inputs.subject.campaign, inputs.subject.state) if part)
    for done, format_name in enumerate(parameters.formats):
        progress(done / len(parameters.formats), f"writing {format_name}")
        exporter = exporter_named(format_name)
        yield DocumentOutput(
            inputs.subject, f"{name}{exporter.suffix}", exporter.media_type, partial(exporter.write, mesh)
        )


KIND = Kind(
    name="export",
    summary="write the merged mesh of a state for Tecplot, ParaView, CAD programs and spreadsheets",
    version=1,
    scope=Scope.STATE,
    parameters=ExportParameters,
    needs=needs,
    run=run,
    subjects=deformed_states,
)
