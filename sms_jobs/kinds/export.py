"""Export: write what is known of a state, with its values, in formats of other programs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from sms_jobs.formats.exporters import all_exporters, exporter_named
from sms_jobs.formats.exporters.exporter import TEXTURE, Exporter
from sms_jobs.formats.exporters.sources import source_for
from sms_jobs.formats.planar_surfaces import planar_grid, planar_mesh
from sms_jobs.kinds.kind import (
    MEASUREMENT,
    DocumentOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Parameters,
    Port,
    Progress,
    Scope,
    every_deformed_state,
)
from sms_jobs.kinds.merge import cameras
from sms_jobs.kinds.products import MEASURED, MERGED, MESH, PLANAR_DISPLACEMENT, PLANAR_STRAIN
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import Mesh

USUAL = ("csv", "obj", "ply", "stl", "tecplot", "vtu")
USUAL_FLAT = ("csv", "npz", "tecplot", "vtu")
"""Of a camera alone: formats of shapes have nothing to hold there."""


_MERGED = Port("merged", "merge", (MERGED, MESH))
_FRAMES = Port("texture", MEASUREMENT, (MEASURED,), several=True)
_MOVED_IN_IMAGE = Port("displacement", "correlate-images", (PLANAR_DISPLACEMENT,), several=True)
_STRAINED_IN_IMAGE = Port("strain", "strain-images", (PLANAR_STRAIN,), several=True)


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

    image_step_px: int = Field(
        4, ge=1, le=64, description="distance of the points of a camera alone in its image"
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


def needs(campaign: Campaign, subject: Subject, parameters: ExportParameters) -> Iterable[Need]:
    """Return the merged result of the state, those of cameras alone, and each camera's texture at rest."""
    seen = cameras(campaign, subject)
    at_rest = replace(subject, state=campaign.reference.label)
    if seen:
        yield _MERGED.of(subject)
    for view in (*(views[0] for views in seen.values()), *campaign.cameras_alone):
        yield _FRAMES.of(replace(at_rest, view=view))
    for view in campaign.cameras_alone:
        yield _MOVED_IN_IMAGE.of(replace(subject, view=view))
        yield _STRAINED_IN_IMAGE.of(replace(subject, view=view))


def run(inputs: Inputs, parameters: ExportParameters, progress: Progress) -> Iterator[Output]:
    """Write the surface of a state: a file for each format, and for each camera if it is over an image."""
    progress(0.0, "reading")
    name = "-".join(part for part in (inputs.subject.campaign, inputs.subject.state) if part)
    if inputs.context:
        yield from _surface(inputs, parameters, name, progress)
    for own in inputs.about(_MOVED_IN_IMAGE):
        progress(0.9, f"writing what {own.view} saw")
        yield from _image(inputs, parameters, own, f"{name}-{own.view}")


def _surface(
    inputs: Inputs, parameters: ExportParameters, name: str, progress: Progress
) -> Iterator[DocumentOutput]:
    """Write the surface that all views of a camera and a projector have measured."""
    textures = {camera: _texture(inputs, views[0]) for camera, views in inputs.context.items()}
    mesh = _with_texture(inputs, textures)
    formats = parameters.formats or USUAL
    for done, format_name in enumerate(formats):
        progress(0.9 * done / len(formats), f"writing {format_name}")
        exporter = exporter_named(format_name)
        files: dict[str, Any]
        if Mesh in exporter.takes or object in exporter.takes:
            files = {name: source_for(exporter, mesh, parameters.fields)}
        else:
            files = {
                f"{name}-{camera}": source_for(
                    exporter, inputs.read(_MERGED, MERGED.of(camera)), texture=texture
                )
                for camera, texture in textures.items()
            }
        for stem, source in files.items():
            yield _document(inputs, exporter, stem, source)


def _image(inputs: Inputs, parameters: ExportParameters, own: Subject, stem: str) -> Iterator[DocumentOutput]:
    """Write displacement and strain in the image of a camera alone, together."""
    grid = planar_grid(
        inputs.read(_MOVED_IN_IMAGE, PLANAR_DISPLACEMENT, own),
        inputs.read(_STRAINED_IN_IMAGE, PLANAR_STRAIN, own),
        _texture(inputs, own.view),
    )
    grid.known()
    mesh = planar_mesh(grid, parameters.image_step_px)
    for format_name in parameters.formats or USUAL_FLAT:
        exporter = exporter_named(format_name)
        meshed = Mesh in exporter.takes or object in exporter.takes
        source = source_for(exporter, mesh, parameters.fields) if meshed else grid
        yield _document(inputs, exporter, stem, source)


def _document(inputs: Inputs, exporter: Exporter, stem: str, source: Any) -> DocumentOutput:
    write = partial(exporter.write, source)
    return DocumentOutput(inputs.subject, f"{stem}{exporter.suffix}", exporter.media_type, write)


def _texture(inputs: Inputs, view: str | None) -> NDArray[np.float32]:
    """Return what a camera saw at rest in a view, (rows, columns), 1 at full scale."""
    (at_rest,) = (own for own in inputs.about(_FRAMES) if own.view == view)
    measurement = inputs.read(_FRAMES, MEASURED, at_rest)
    return (measurement.texture / np.float32(measurement.full_scale)).astype(np.float32)


def _with_texture(inputs: Inputs, textures: dict[str, NDArray[np.float32]]) -> Mesh:
    """Return the merged mesh with the texture of the pixel that each vertex is.

    Vertices are positions of pixels, bit by bit, which is how the pixels are found again; where a vertex is
    none, its texture is NaN, and where none is, the mesh stays as it is.
    """
    mesh = inputs.read(_MERGED, MESH)
    grey = np.full(len(mesh.vertices), np.nan)
    wanted = _keys(mesh.vertices)
    for camera, texture in textures.items():
        xyz = inputs.read(_MERGED, MERGED.of(camera)).xyz
        known = np.isfinite(xyz).all(axis=0)
        points = np.ascontiguousarray(xyz[:, known].T)
        if len(points) == 0:
            continue
        keys = _keys(points)
        order = np.argsort(keys)
        place = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(order) - 1)]
        found = (points[place] == mesh.vertices).all(axis=1)
        grey[found] = texture[known][place[found]]
    if not np.isfinite(grey).any():
        return mesh
    return replace(
        mesh,
        value_names=(*mesh.value_names, TEXTURE),
        value_units=(*mesh.value_units, "1"),
        values=np.concatenate([mesh.values, grey[None]]),
    )


def _keys(points: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return a number for each of the points (n, 3) that equal points share and others hardly ever do."""
    x, y, z = (np.ascontiguousarray(column).view(np.uint64) for column in points.T)
    return x * np.uint64(0x9E3779B97F4A7C15) + y * np.uint64(0xC2B2AE3D27D4EB4F) + z


KIND = Kind(
    name="export",
    summary="write what is known of a state for Tecplot, ParaView, CAD, MATLAB and spreadsheets",
    version=3,
    scope=Scope.STATE,
    parameters=ExportParameters,
    inputs=(_MERGED, _FRAMES, _MOVED_IN_IMAGE, _STRAINED_IN_IMAGE),
    outputs=(),
    needs=needs,
    run=run,
    subjects=every_deformed_state,
    context=cameras,
)
