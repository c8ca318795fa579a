"""Merge: the views of each camera into one field, and all cameras into one surface (thesis section 5.2.3)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.calibration_factors import median_part, merged_sigma, states_of
from sms_jobs.kinds.deformation.view_gaps import calibrations_variance, told_of_views
from sms_jobs.kinds.kind import (
    DatasetOutput,
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
from sms_jobs.kinds.port_names import AT_REST, MOVED
from sms_jobs.kinds.products import (
    CALIBRATION_FACTOR,
    DISPLACEMENT,
    MERGED,
    MESH,
    REGIONS,
    STRAIN,
    SURFACE,
    Product,
)
from sms_jobs.kinds.surface_ports import position_covariance, surface_port
from sms_jobs.kinds.valid_parts import fractions
from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.deformation.joining.merging import (
    Merged,
    combine_labels,
    contradictions,
    correlation_of_pairs,
    join_meshes,
    merge_by_variance,
    weights_of_pairs,
)
from sms_jobs.metrology.deformation.strain.tangent_plane import principal_and_equivalent
from sms_jobs.metrology.geometry.planes import covariance_in_plane, covariance_in_space, in_space, trace
from sms_jobs.metrology.surfaces.meshing import triangulate_image
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.field_names import (
    DISPLACEMENT_LENGTH,
    DISPLACEMENT_SIGMA,
    DISPLACEMENT_XYZ,
    PRINCIPAL_STRAINS,
    SIGMA_CALIBRATION,
    STRAIN_VALUES,
    VON_MISES,
    sigma_of,
)
from sms_jobs.records.fields import Axis, DisplacementField, MergedField, Mesh, Surface
from sms_jobs.records.quantity import SYMMETRIC
from sms_jobs.records.reasons import Reason
from sms_jobs.records.remarks import remarked
from sms_jobs.records.sizes import number_of
from sms_jobs.records.statistic_names import maximum_displacement, of_camera
from sms_jobs.records.subject import Subject

_DIAGONAL = [SYMMETRIC.index(name) for name in ("XX", "YY", "ZZ")]
_STEP_PX, _STEP_IN_PLANE_PX = 1, 4


class MergeParameters(Parameters):
    """How fine the common surface is."""

    mesh_step_px: int | None = Field(
        None,
        ge=1,
        le=64,
        description="distance of the mesh's vertices in the image; if not given "
        f"{_STEP_PX}, and {_STEP_IN_PLANE_PX} of a camera alone",
    )


_MOVED = Port(MOVED, "correlate", (DISPLACEMENT, REGIONS, CALIBRATION_FACTOR), several=True)
_STRAINED = Port("strain", "strain", (STRAIN,), several=True)
_REFERENCE = surface_port(AT_REST, several=True)


@dataclass(frozen=True)
class _Seen:
    """What one camera sees: its merged field, its mesh with values, and where it could measure.

    `told` is which of its views contradict each other.
    """

    field: MergedField
    mesh: Mesh
    measurable: Mask
    told: str


def _needs(campaign: Campaign, subject: Subject, parameters: MergeParameters) -> Iterable[Need]:
    for view in campaign.measured_views:
        own = replace(subject, view=view)
        yield _MOVED.of(own)
        yield _STRAINED.of(own)
        yield _REFERENCE.of(campaign, replace(own, state=campaign.reference.label))


def _views_by_camera(campaign: Campaign, subject: Subject) -> dict[str, tuple[str, ...]]:
    return campaign.views_by_camera()


def run(inputs: Inputs, parameters: MergeParameters, progress: Progress) -> Iterator[Output]:
    """Merge the views of every camera, then join the surfaces of all that measure in one frame."""
    seen = []
    for number, (camera, views) in enumerate(inputs.context.items()):
        seen.append(_of_camera(inputs, camera, views, parameters))
        progress(0.8 * (number + 1) / len(inputs.context), f"merged {', '.join(views)}")
    records: dict[Product[Any], object] = {MERGED.of(one.field.camera): one.field for one in seen}
    in_world = [one for one in seen if one.field.has_depth]
    meshes = {MESH.of(s.field.camera): _joined([s.mesh]) for s in seen if s not in in_world}
    if in_world:
        meshes[MESH] = _joined([one.mesh for one in in_world])
    progress(
        1.0, remarked(*(one.told for one in seen), beside=f"joined {number_of(len(in_world), 'camera')}")
    )
    yield DatasetOutput(inputs.subject, {**records, **meshes}, _statistics(seen, list(meshes.values())))


def _of_camera(inputs: Inputs, camera: str, views: tuple[str, ...], parameters: MergeParameters) -> _Seen:
    """Merge what the views of one camera say, and put triangles between its pixels."""
    field, measurable, told = _merged_camera(inputs, camera, views)
    strain, axis = _merged_strain(inputs, views)
    labels = combine_labels([inputs.read(_MOVED, REGIONS, own).labels for own in _of(inputs, views)])
    labels[field.reason != Reason.VALID] = 0
    usual = _STEP_PX if field.has_depth else _STEP_IN_PLANE_PX
    pixels, faces = triangulate_image(labels, parameters.mesh_step_px or usual)
    row, column = pixels.T
    names, units, values = zip(*_values(field, strain), strict=True)
    mesh = Mesh(
        names,
        units,
        np.ascontiguousarray(field.position[:, row, column].T),
        faces,
        np.stack([value[row, column] for value in values]),
        field.unit,
        (camera,),
        np.zeros(len(row), np.uint8),
        np.stack([column, row]).astype(np.int32),
        axis,
    )
    return _Seen(field, mesh, measurable, told)


def _joined(meshes: Sequence[Mesh]) -> Mesh:
    """Join the surfaces of cameras in one frame; of what two see, the first keeps its triangles.

    Values that one of them has not got are left out.
    """
    vertices, faces, source, vertex = join_meshes([(mesh.vertices, mesh.faces) for mesh in meshes])
    each = [vertex[source == number] for number in range(len(meshes))]
    together = list(zip(meshes, each, strict=True))
    first = meshes[0]
    _one_axis({", ".join(mesh.cameras): mesh.strain_axis for mesh in meshes})
    names = [name for name in first.value_names if all(name in mesh.value_names for mesh in meshes)]
    return replace(
        first,
        value_names=tuple(names),
        value_units=tuple(first.value_units[first.value_names.index(name)] for name in names),
        vertices=vertices,
        faces=faces,
        values=np.stack(
            [np.concatenate([mesh.value(name)[kept] for mesh, kept in together]) for name in names]
        ),
        cameras=tuple(name for mesh in meshes for name in mesh.cameras),
        camera=source.astype(np.uint8),
        pixel=np.concatenate(
            [mesh.pixel[:, kept] for mesh, kept in together if mesh.pixel is not None], axis=1
        ),
    )


def _of(inputs: Inputs, views: Sequence[str]) -> list[Subject]:
    """Return the tuples of some views at the state."""
    return [replace(inputs.subject, view=view) for view in views]


def _merged_camera(inputs: Inputs, camera: str, views: tuple[str, ...]) -> tuple[MergedField, Mask, str]:
    """Merge displacement, and the shape where there is displacement, over the views of one camera.

    Beside them stands where any of the views has a shape, and which of them contradict each other.
    """
    moved = [inputs.read(_MOVED, DISPLACEMENT, own) for own in _of(inputs, views)]
    at_rest = {own.view: own for own in inputs.about(_REFERENCE.port)}
    surfaces = [inputs.read(_REFERENCE.port, SURFACE, at_rest[view]) for view in views]
    vectors = [in_space(d.displacement) for d in moved]
    covariances = [covariance_in_space(d.covariance) for d in moved]
    displacement = _merged(vectors, covariances)
    position = merge_by_variance(
        [
            np.where(d.reason == Reason.VALID, in_space(s.position), np.nan)
            for d, s in zip(moved, surfaces, strict=True)
        ],
        [position_covariance(s) for s in surfaces],
    )
    missing = displacement.contributors == 0
    reason = np.zeros(missing.shape, dtype=np.uint32)
    reason[missing] = np.bitwise_or.reduce([d.reason for d in moved])[missing]
    apart = contradictions(vectors, covariances, [calibrations_variance(d) for d in moved])
    covariance = (displacement.covariance + apart).astype(np.float32)
    axes = len(surfaces[0].position)
    resolution_px, resolution = _resolution(moved)
    field = MergedField(
        camera,
        views,
        surfaces[0].unit,
        displacement.discrepancy_rms,
        displacement.value[:axes],
        position.value[:axes],
        covariance if surfaces[0].has_depth else covariance_in_plane(covariance),
        displacement.contributors,
        reason,
        displacement.discrepancy.astype(np.float32),
        surfaces[0].mm_per_px,
        _calibrations_part(inputs, views, surfaces, moved),
        resolution_px=resolution_px,
        resolution=resolution,
    )
    measurable = np.logical_or.reduce([s.reason == Reason.VALID for s in surfaces])
    return field, measurable, told_of_views(views, moved)


def _resolution(moved: Sequence[DisplacementField]) -> tuple[float | None, Singles | None]:
    """Return the coarsest spatial resolution of the views, in px and at each pixel; None if one has none."""
    in_px = [d.resolution_px for d in moved if d.resolution_px is not None]
    each = [d.resolution for d in moved if d.resolution is not None]
    if len(each) < len(moved):
        return None, None
    return max(in_px), np.asarray(np.fmax.reduce(each))


def _calibrations_part(
    inputs: Inputs, views: Sequence[str], surfaces: Sequence[Surface], moved: Sequence[DisplacementField]
) -> Singles | None:
    """Return the calibration's part of the merged displacement's sigma; None where a view has none."""
    known = [states_of(inputs, _MOVED, own) for own in _of(inputs, views)]
    states = [one for one in known if one is not None]
    if len(states) < len(views):
        return None
    weights = weights_of_pairs([d.displacement for d in moved], [d.covariance for d in moved])
    valid = np.isfinite(weights[0])
    return merged_sigma(list(zip(states, surfaces, moved, strict=True)), list(weights), valid)


def _one_axis(axes: Mapping[str, Axis | None]) -> Axis | None:
    """Return the x axis that strain of views or cameras has; `InvalidInput` where they have not the same."""
    if len(set(axes.values())) > 1:
        raise InvalidInput(
            f"the strains of {' and '.join(axes)} lie along different axes, since the specimen's frame was "
            "changed between them: submit strain of all of them again"
        )
    return next(iter(axes.values()))


def _merged_strain(inputs: Inputs, views: tuple[str, ...]) -> tuple[Merged, Axis | None]:
    """Merge the strain (xx, yy, xy) of the views of one camera, and say along which axis it lies.

    Their tangent planes are the same.
    """
    fields = [inputs.read(_STRAINED, STRAIN, own) for own in _of(inputs, views)]
    axis = _one_axis({view: field.x_axis for view, field in zip(views, fields, strict=True)})
    variances = []
    for field in fields:
        packed = np.zeros((6, *field.reason.shape))
        packed[_DIAGONAL] = field.sigma.astype(np.float64) ** 2
        variances.append(packed)
    return _merged([f.strain for f in fields], variances), axis


def _merged(values: Sequence[Floats], covariances: Sequence[NDArray[np.floating]]) -> Merged:
    """Merge what views of one camera say of its texture, whose errors they share in part."""
    return merge_by_variance(values, covariances, correlation_of_pairs(values, covariances))


def _values(field: MergedField, strain: Merged) -> list[tuple[str, str, Floats]]:
    """Return what is known of every pixel of a camera: names, units and (rows, columns)."""
    sigma = np.sqrt(trace(field.covariance))
    principal, von_mises = principal_and_equivalent(strain.value)
    strains = list(zip(STRAIN_VALUES, strain.value, np.sqrt(strain.covariance[_DIAGONAL]), strict=True))
    return [
        *(
            (name, field.unit, value)
            for name, value in zip(DISPLACEMENT_XYZ, field.displacement, strict=False)
        ),
        (DISPLACEMENT_LENGTH, field.unit, np.linalg.norm(field.displacement, axis=0)),
        (DISPLACEMENT_SIGMA, field.unit, sigma),
        *_known_parts(field),
        *((name, "1", value) for name, value, _ in strains),
        *((sigma_of(name), "1", value) for name, _, value in strains),
        *((name, "1", value) for name, value in zip(PRINCIPAL_STRAINS, principal, strict=True)),
        (VON_MISES, "1", von_mises),
    ]


def _known_parts(field: MergedField) -> list[tuple[str, str, Floats]]:
    """Return the calibration's part of the displacement's sigma, where it is known."""
    if field.sigma_calibration is None:
        return []
    length = np.sqrt(np.sum(np.square(field.sigma_calibration, dtype=np.float64), axis=0))
    return [(SIGMA_CALIBRATION, field.unit, length)]


def _statistics(seen: Sequence[_Seen], meshes: Sequence[Mesh]) -> dict[str, float]:
    """Return what people search by; a discrepancy only where views overlap."""
    statistics = {
        "vertices": float(sum(len(mesh.vertices) for mesh in meshes)),
        "faces": float(sum(len(mesh.faces) for mesh in meshes)),
    }
    for one in seen:
        found = fractions(one.field.reason == Reason.VALID, one.measurable)
        statistics |= {of_camera(name, one.field.camera): value for name, value in found.items()}
        part = median_part(one.field.sigma_calibration, one.field.unit)
        statistics |= {of_camera(name, one.field.camera): value for name, value in part.items()}
        if np.isfinite(one.field.discrepancy_rms):
            statistics[of_camera(f"discrepancy_rms_{one.field.unit}", one.field.camera)] = (
                one.field.discrepancy_rms
            )
    for unit in dict.fromkeys(mesh.unit for mesh in meshes):
        largest = [
            mesh.value(DISPLACEMENT_LENGTH).max()
            for mesh in meshes
            if mesh.unit == unit and len(mesh.vertices)
        ]
        if largest:
            statistics[maximum_displacement(unit)] = float(max(largest))
    return statistics


KIND = Kind(
    name="merge",
    summary="views of a camera merged by inverse variance, and all cameras joined into one surface",
    version=10,
    scope=Scope.STATE,
    parameters=MergeParameters,
    inputs=(_MOVED, _STRAINED, *_REFERENCE.all),
    outputs=(MERGED.by("camera"), MESH.by("camera")),
    needs=_needs,
    run=run,
    subjects=every_deformed_state,
    context=_views_by_camera,
)
