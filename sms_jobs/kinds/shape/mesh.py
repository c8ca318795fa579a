"""Mesh: the shape at a state as one surface of triangles, of all cameras (thesis section 2.5)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sms_jobs.kinds.kind import MEASUREMENT, DatasetOutput, Inputs, Kind, Need, Output, Port, Progress, Scope
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import MEASURED, MESH
from sms_jobs.kinds.shape.camera_views import SHAPES, CameraView, camera_views, cameras, cloud_needs
from sms_jobs.kinds.surface_ports import textured_by
from sms_jobs.metrology.deformation.joining.merging import join_meshes
from sms_jobs.metrology.surfaces.continuity import fill_small_holes
from sms_jobs.metrology.surfaces.meshing import triangulate_image
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.field_names import POSITION, TEXTURE, sigma_of
from sms_jobs.records.fields import Mesh
from sms_jobs.records.sizes import number_of
from sms_jobs.records.statistic_names import of_camera
from sms_jobs.records.subject import Subject

_VALUES = ((sigma_of(POSITION), "mm"), (TEXTURE, "1"), ("filled", "1"))


class MeshParameters(Parameters):
    """How fine the surface is, and which of its holes are filled."""

    mesh_step_px: int = Field(1, ge=1, le=64, description="distance of the mesh's vertices in the image")
    fill_holes_px: int = Field(
        0,
        ge=0,
        description="holes of up to so many pixels are filled and marked in the value 'filled'; 0 for none",
    )


_FRAMES = Port("texture", MEASUREMENT, (MEASURED,), several=True)


def needs(campaign: Campaign, subject: Subject, parameters: MeshParameters) -> Iterable[Need]:
    """Return the points of every view, and a measurement of each camera for its texture."""
    yield from cloud_needs(campaign, subject)
    for views in cameras(campaign, subject).values():
        yield _FRAMES.of(textured_by(replace(subject, view=views[0])))


def run(inputs: Inputs, parameters: MeshParameters, progress: Progress) -> Iterator[Output]:
    """Join neighbouring pixels of each camera, never across a discontinuity or a hole, then the cameras."""
    surfaces, values = [], []
    statistics: dict[str, float] = {}
    for number, view in enumerate(camera_views(inputs)):
        filled = fill_small_holes(view.xyz, view.labels, parameters.fill_holes_px)
        pixels, faces = triangulate_image(filled.labels, parameters.mesh_step_px)
        row, column = pixels.T
        surfaces.append((np.ascontiguousarray(filled.xyz[:, row, column].T), faces))
        values.append(_values(inputs, view, filled.filled)[:, row, column])
        statistics[of_camera("filled_holes", view.camera)] = float(filled.holes)
        progress((number + 1) / (len(inputs.context) + 1), f"meshed {view.camera}")
    vertices, faces, camera, vertex = join_meshes(surfaces)
    at_vertices = [part[:, vertex[camera == k]] for k, part in enumerate(values)]
    names, units = zip(*_VALUES, strict=True)
    mesh = Mesh(names, units, vertices, faces, np.concatenate(at_vertices, axis=1))
    statistics |= {"vertices": float(len(vertices)), "faces": float(len(faces))}
    progress(1.0, f"joined {number_of(len(surfaces), 'view')}")
    yield DatasetOutput(inputs.subject, {MESH: mesh}, statistics)


def _values(inputs: Inputs, view: CameraView, filled: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the values of `_VALUES` at every pixel of a camera; a filled one has no standard deviation."""
    measurement = inputs.read(_FRAMES, MEASURED, textured_by(replace(inputs.subject, view=view.views[0])))
    sigma = np.where(filled, np.nan, view.sigma())
    return np.stack([sigma, measurement.texture / measurement.full_scale, filled.astype(np.float64)])


KIND = Kind(
    name="mesh",
    summary="the shape at a state as one mesh of all cameras, with texture, small holes filled on request",
    version=1,
    scope=Scope.STATE,
    parameters=MeshParameters,
    inputs=(*SHAPES.all, _FRAMES),
    outputs=(MESH,),
    needs=needs,
    run=run,
    context=cameras,
    in_pipeline=False,
)
