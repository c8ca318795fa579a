"""Export: write what is known of a state, with its values, in formats of other programs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from sms_jobs.errors import InvalidInput, did_you_mean
from sms_jobs.formats.exporters import all_exporters, exporter_named
from sms_jobs.formats.exporters.exporter import Exporter
from sms_jobs.formats.exporters.sources import source_for
from sms_jobs.kinds.documents import Document, DocumentOutput
from sms_jobs.kinds.kind import (
    MEASUREMENT,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    every_deformed_state,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import MEASURED, MERGED, MESH
from sms_jobs.kinds.surface_ports import textured_by
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.field_names import IN_SPACE, MERGED_VALUES, TEXTURE
from sms_jobs.records.fields import Mesh
from sms_jobs.records.remarks import remarked
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

USUAL = ("csv", "obj", "ply", "stl", "tecplot", "vtu")
USUAL_FLAT = ("csv", "npz", "tecplot", "vtu")
"""Of a camera alone: formats of shapes have nothing to hold there."""


_MERGED = Port("merged", "merge", (MERGED, MESH))
_FRAMES = Port("texture", MEASUREMENT, (MEASURED,), several=True)


class ExportParameters(Parameters):
    """Which files are written, and with which values."""

    formats: tuple[str, ...] | None = Field(
        None,
        min_length=1,
        description="names of the formats to write; 'sms data formats' lists them; if not given "
        f"{', '.join(USUAL)}, and of a camera alone {', '.join(USUAL_FLAT)}",
    )
    fields: tuple[str, ...] = Field(
        (), description="values of the mesh to write, e.g. 'displacement Z'; all if not given"
    )

    @field_validator("formats", "fields", mode="before")
    @classmethod
    def _one_or_several(cls, given: Any) -> Any:
        return (given,) if isinstance(given, str) else given

    @field_validator("formats")
    @classmethod
    def _known_and_different(cls, formats: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if formats is None:
            return None
        unknown = [name for name in formats if name not in all_exporters()]
        if unknown:
            raise ValueError(f"there is no format {unknown[0]}; choose among {', '.join(all_exporters())}")
        return tuple(dict.fromkeys(formats))

    @field_validator("fields")
    @classmethod
    def _known(cls, fields: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in fields if name not in MERGED_VALUES]
        if unknown:
            meant = did_you_mean(unknown[0], MERGED_VALUES)
            raise ValueError(
                f"there is no value '{unknown[0]}'; {meant}choose among {', '.join(MERGED_VALUES)}"
            )
        return fields


def needs(campaign: Campaign, subject: Subject, parameters: ExportParameters) -> Iterable[Need]:
    """Return the merged result of the state, and each camera's texture at rest.

    Raises `InvalidInput` for a value that the image of a camera alone has not.
    """
    in_space = next((name for name in parameters.fields if name in IN_SPACE), None)
    if in_space is not None and campaign.cameras_alone:
        raise InvalidInput(
            f"fields has '{in_space}', which the image of {campaign.cameras_alone[0]} alone does not have; "
            f"choose among {', '.join(name for name in MERGED_VALUES if name not in IN_SPACE)}"
        )
    yield _MERGED.of(subject)
    at_rest = replace(subject, state=campaign.reference.label)
    for views in campaign.views_by_camera().values():
        yield _FRAMES.of(textured_by(replace(at_rest, view=views[0])))


def _first_views(campaign: Campaign, subject: Subject) -> dict[str, str]:
    """Return the view whose recording shows the texture, by camera."""
    return {c: str(view_of(views[0]).recordings[0]) for c, views in campaign.views_by_camera().items()}


def run(inputs: Inputs, parameters: ExportParameters, progress: Progress) -> Iterator[Output]:
    """Write the surfaces of a state: a file for each format, and for each camera if it is over an image."""
    progress(0.0, "reading")
    name = inputs.subject.in_filename
    textures = {camera: _texture(inputs, view) for camera, view in inputs.context.items()}
    found, empty = inputs.each(_MERGED, MESH), list[str]()
    for number, product in enumerate(found):
        mesh = _with_texture(inputs.read(_MERGED, product), textures)
        # The world is one; of planes each is a world of its own.
        stem = f"{name}-{product.key}" if product.key else name
        if not len(mesh.faces):
            # That nothing is valid is a result, too, which the jobs before have told.
            empty.append(stem)
            continue
        progress((number + 1) / (len(found) + 1), f"writing {stem}")
        for format_name in parameters.formats or (USUAL if mesh.has_depth else USUAL_FLAT):
            exporter = exporter_named(format_name)
            if Mesh in exporter.takes or object in exporter.takes:
                yield _written(inputs, exporter, stem, source_for(exporter, mesh, parameters.fields))
                continue
            for camera in mesh.cameras:
                field = inputs.read(_MERGED, MERGED.of(camera))
                seen = source_for(exporter, field, texture=textures[camera])
                yield _written(inputs, exporter, f"{name}-{camera}", seen)
    if empty:
        where = "where no square of pixels has values"
        progress(1.0, remarked(f"nothing to export of {' and '.join(empty)}, {where}"))


def _written(inputs: Inputs, exporter: Exporter, stem: str, source: Any) -> DocumentOutput:
    write = partial(exporter.write, source)
    return DocumentOutput(inputs.subject, _document_of(exporter), f"{stem}{exporter.suffix}", write)


def _document_of(exporter: Exporter) -> Document:
    """Return what a file of a format is declared as; of planes there is one for each camera."""
    return Document(exporter.name, exporter.media_type, "camera")


def _texture(inputs: Inputs, view: str | None) -> NDArray[np.float32]:
    """Return what a camera saw at rest in a view, (rows, columns), 1 at full scale."""
    (at_rest,) = (own for own in inputs.about(_FRAMES) if own.view == view)
    measurement = inputs.read(_FRAMES, MEASURED, at_rest)
    return (measurement.texture / np.float32(measurement.full_scale)).astype(np.float32)


def _with_texture(mesh: Mesh, textures: Mapping[str, NDArray[np.float32]]) -> Mesh:
    """Return a mesh with the texture of the pixel that each vertex is."""
    if mesh.camera is None or mesh.pixel is None:
        return mesh
    grey = np.full(len(mesh.vertices), np.nan)
    for number, camera in enumerate(mesh.cameras):
        own = mesh.camera == number
        column, row = mesh.pixel[:, own]
        grey[own] = textures[camera][row, column]
    return mesh.with_value(TEXTURE, "1", grey)


KIND = Kind(
    name="export",
    summary="write what is known of a state for Tecplot, ParaView, CAD, MATLAB and spreadsheets",
    version=5,
    scope=Scope.STATE,
    parameters=ExportParameters,
    inputs=(_MERGED, _FRAMES),
    outputs=tuple(map(_document_of, all_exporters().values())),
    needs=needs,
    run=run,
    subjects=every_deformed_state,
    context=_first_views,
)
