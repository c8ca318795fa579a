"""Merge: the views of each camera into one field, and all cameras into one surface (thesis section 5.2.3)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sms_jobs.kinds.kind import (
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Parameters,
    Port,
    Progress,
    Scope,
    deformed_states,
)
from sms_jobs.kinds.products import CLOUD, DISPLACEMENT, MERGED, MESH, REGIONS, STRAIN
from sms_jobs.kinds.valid_parts import fractions
from sms_jobs.metrology.deformation.merging import (
    Merged,
    combine_labels,
    correlation_of_pairs,
    join_meshes,
    merge_by_variance,
)
from sms_jobs.metrology.surfaces.meshing import triangulate_image
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import MergedField, Mesh
from sms_jobs.records.quantity import SYMMETRIC
from sms_jobs.records.reasons import Reason
from sms_jobs.records.views import view_of

Floats: TypeAlias = NDArray[np.float64]
Mask: TypeAlias = NDArray[np.bool_]

_DIAGONAL = [SYMMETRIC.index(name) for name in ("XX", "YY", "ZZ")]
_VALUES = (
    *((f"displacement {axis}", "mm") for axis in "XYZ"),
    ("displacement", "mm"),
    ("sigma of displacement", "mm"),
    *((f"strain {component}", "1") for component in ("xx", "yy", "xy")),
    *((f"sigma of strain {component}", "1") for component in ("xx", "yy", "xy")),
)
"""Names and units of the values at the vertices of the mesh."""


class MergeParameters(Parameters):
    """How fine the common surface is."""

    mesh_step_px: int = Field(1, ge=1, le=64, description="distance of the mesh's vertices in the image")


_MOVED = Port("displacement", "correlate", (DISPLACEMENT, REGIONS), several=True)
_STRAINED = Port("strain", "strain", (STRAIN,), several=True)
_REFERENCE = Port("reference", "reconstruct", (CLOUD,), several=True)


def _needs(campaign: Campaign, subject: Subject, parameters: MergeParameters) -> Iterable[Need]:
    for view in campaign.shape_views:
        own = replace(subject, view=view)
        yield _MOVED.of(own)
        yield _STRAINED.of(own)
        yield _REFERENCE.of(replace(own, state=campaign.reference.label))


def cameras(campaign: Campaign, subject: Subject) -> dict[str, tuple[str, ...]]:
    """Return the views of each camera that measures shape, in the campaign's order."""
    found: dict[str, tuple[str, ...]] = {}
    for view in campaign.shape_views:
        camera = view_of(view).camera
        found[camera] = (*found.get(camera, ()), view)
    return found


def run(inputs: Inputs, parameters: MergeParameters, progress: Progress) -> Iterator[Output]:
    """Merge the views of every camera, then join the cameras' surfaces."""
    fields: dict[str, MergedField] = {}
    surfaces: list[tuple[Floats, NDArray[np.int32]]] = []
    values: list[Floats] = []
    parts: dict[str, float] = {}
    for number, (camera, views) in enumerate(inputs.context.items()):
        field, measurable = _merged_camera(inputs, camera, views)
        strain = _merged_strain(inputs, views)
        labels = combine_labels([inputs.read(_MOVED, REGIONS, own).labels for own in _of(inputs, views)])
        labels[field.reason != Reason.VALID] = 0
        pixels, faces = triangulate_image(labels, parameters.mesh_step_px)
        row, column = pixels.T
        fields[camera] = field
        parts |= _parts(field, measurable)
        surfaces.append((field.xyz[:, row, column].T, faces))
        values.append(_vertex_values(field, strain)[:, row, column])
        progress(0.8 * (number + 1) / len(inputs.context), f"merged {', '.join(views)}")
    vertices, faces, source, vertex = join_meshes(surfaces)
    at_vertices = [values[k][:, vertex[source == k]] for k in range(len(values))]
    names, units = zip(*_VALUES, strict=True)
    mesh = Mesh(names, units, vertices, faces, np.concatenate(at_vertices, axis=1))
    progress(1.0, f"joined {len(fields)} cameras")
    merged = {MERGED.of(camera): field for camera, field in fields.items()}
    yield DatasetOutput(inputs.subject, {**merged, MESH: mesh}, _statistics(fields, mesh) | parts)


def _of(inputs: Inputs, views: Sequence[str]) -> list[Subject]:
    """Return the tuples of some views at the state."""
    return [replace(inputs.subject, view=view) for view in views]


def _merged_camera(inputs: Inputs, camera: str, views: tuple[str, ...]) -> tuple[MergedField, Mask]:
    """Merge displacement, and the shape where there is displacement, over the views of one camera.

    Beside them stands where any of the views has a shape.
    """
    moved = [inputs.read(_MOVED, DISPLACEMENT, own) for own in _of(inputs, views)]
    at_rest = {own.view: own for own in inputs.about(_REFERENCE)}
    clouds = [inputs.read(_REFERENCE, CLOUD, at_rest[view]) for view in views]
    displacement = _merged([d.displacement for d in moved], [d.covariance for d in moved])
    shape = merge_by_variance(
        [np.where(d.reason == Reason.VALID, c.xyz, np.nan) for d, c in zip(moved, clouds, strict=True)],
        [c.covariance for c in clouds],
    )
    missing = displacement.contributors == 0
    reason = np.zeros(missing.shape, dtype=np.uint32)
    reason[missing] = np.bitwise_or.reduce([d.reason for d in moved])[missing]
    field = MergedField(
        camera,
        views,
        displacement.discrepancy_rms,
        displacement.value,
        shape.value,
        displacement.covariance.astype(np.float32),
        displacement.contributors,
        reason,
        displacement.discrepancy.astype(np.float32),
    )
    return field, np.logical_or.reduce([c.reason == Reason.VALID for c in clouds])


def _merged_strain(inputs: Inputs, views: tuple[str, ...]) -> Merged:
    """Merge the strain (xx, yy, xy) of the views of one camera; their tangent planes are the same."""
    fields = [inputs.read(_STRAINED, STRAIN, own) for own in _of(inputs, views)]
    variances = []
    for field in fields:
        packed = np.zeros((6, *field.reason.shape))
        packed[_DIAGONAL] = field.sigma.astype(np.float64) ** 2
        variances.append(packed)
    return _merged([f.strain for f in fields], variances)


def _merged(values: Sequence[Floats], covariances: Sequence[NDArray[np.floating]]) -> Merged:
    """Merge what views of one camera say of its texture, whose errors they share in part."""
    return merge_by_variance(values, covariances, correlation_of_pairs(values, covariances))


def _vertex_values(field: MergedField, strain: Merged) -> Floats:
    """Return the values of `_VALUES` at every pixel of a camera."""
    return np.concatenate(
        [
            field.displacement,
            np.linalg.norm(field.displacement, axis=0)[None],
            np.sqrt(field.covariance[_DIAGONAL].sum(axis=0, dtype=np.float64))[None],
            strain.value,
            np.sqrt(strain.covariance[_DIAGONAL]),
        ]
    )


def _parts(field: MergedField, measurable: Mask) -> dict[str, float]:
    """Return which part of what a camera could measure is valid, and of its image."""
    found = fractions(field.reason == Reason.VALID, measurable)
    return {f"{name}_{field.camera}": value for name, value in found.items()}


def _statistics(fields: dict[str, MergedField], mesh: Mesh) -> dict[str, float]:
    """Return what people search by; a discrepancy only where views overlap."""
    statistics = {"vertices": float(len(mesh.vertices)), "faces": float(len(mesh.faces))}
    for camera, field in fields.items():
        if np.isfinite(field.discrepancy_rms_mm):
            statistics[f"discrepancy_rms_mm_{camera}"] = field.discrepancy_rms_mm
    if len(mesh.vertices):
        statistics["maximum_displacement_mm"] = float(mesh.values[3].max())
    return statistics


KIND = Kind(
    name="merge",
    summary="views of a camera merged by inverse variance, and all cameras joined into one surface",
    version=4,
    scope=Scope.STATE,
    parameters=MergeParameters,
    inputs=(_MOVED, _STRAINED, _REFERENCE),
    outputs=(MERGED, MESH),
    needs=_needs,
    run=run,
    subjects=deformed_states,
    context=cameras,
)
