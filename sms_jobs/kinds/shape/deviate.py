"""Deviate: the shape at a state against the reference surface of its campaign (thesis section 2.5)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from sms_jobs.formats.deviation_figures import write_deviation_map
from sms_jobs.kinds.documents import Document, DocumentOutput
from sms_jobs.kinds.kind import (
    REFERENCE_SURFACES,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import DEVIATION, MESH, REFERENCE_SURFACE, REGISTRATION, Product
from sms_jobs.kinds.shape.camera_views import SHAPES, CameraView, camera_views, cameras, cloud_needs
from sms_jobs.metrology.deformation.joining.merging import join_meshes
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import rotation_matrix, turn_covariance
from sms_jobs.metrology.surfaces.coarse_registration import coarse_registration
from sms_jobs.metrology.surfaces.deviation import (
    PERCENTILES,
    deviations,
    statistics_of,
    verdicts,
)
from sms_jobs.metrology.surfaces.meshing import triangulate_image
from sms_jobs.metrology.surfaces.normals import image_normals
from sms_jobs.metrology.surfaces.registration import MeasuredPoints, Registration, register
from sms_jobs.metrology.surfaces.triangle_surface import TriangleSurface, triangle_surface
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.field_names import DEVIATION_OVER_SIGMA, DEVIATION_VALUE, sigma_of
from sms_jobs.records.fields import Mesh
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject
from sms_jobs.records.surfaces import (
    DeviationField,
    ReferenceSurface,
    SurfaceRegistration,
)

_VALUES = (
    (DEVIATION_VALUE, "mm"),
    (sigma_of(DEVIATION_VALUE), "mm"),
    (DEVIATION_OVER_SIGMA, "1"),
    ("verdict", "1"),
)
Vector = tuple[float, float, float]


class DeviateParameters(Parameters):
    """How the shape is laid on the reference surface, and what it may be off by."""

    lower_mm: float = Field(-0.1, description="lower limit of the tolerance, negative into the material")
    upper_mm: float = Field(0.1, description="upper limit of the tolerance, positive out of the material")
    coverage_factor: float = Field(
        2.0, ge=0.0, description="standard deviations on each side that a verdict allows for"
    )
    start: Literal["principal-axes", "given"] = Field(
        "principal-axes", description="where the registration starts: found by itself, or as given below"
    )
    rotation_rad: Vector = Field(
        (0.0, 0.0, 0.0), description="rotation vector of a given start, world into the surface's frame"
    )
    translation_mm: Vector = Field((0.0, 0.0, 0.0), description="shift of a given start, after the rotation")
    iterations: int = Field(
        50, ge=0, le=1000, description="of the registration at most; 0 keeps a given start as it is"
    )
    registration_points: int = Field(
        20_000, ge=100, description="points that the registration uses, evenly chosen"
    )
    within_mm: float = Field(
        5.0, gt=0.0, description="points farther from the registered surface than this have no counterpart"
    )
    mesh_step_px: int = Field(1, ge=1, le=64, description="distance of the mesh's vertices in the image")

    @model_validator(mode="after")
    def _limits(self) -> DeviateParameters:
        if not self.lower_mm < self.upper_mm:
            raise ValueError(f"lower_mm {self.lower_mm:g} must be below upper_mm {self.upper_mm:g}")
        if self.iterations == 0 and self.start != "given":
            raise ValueError("iterations can be 0 with start 'given' only: there is nothing to keep")
        return self


@dataclass(frozen=True)
class _View:
    """What a camera sees, and which of its pixels are points."""

    view: CameraView
    known: NDArray[np.bool_]
    points: MeasuredPoints


_MAP = Document("deviation", "image/png", "camera")
_REFERENCE = Port("surface", REFERENCE_SURFACES, (REFERENCE_SURFACE,))


def needs(campaign: Campaign, subject: Subject, parameters: DeviateParameters) -> Iterable[Need]:
    """Return the points of every view, and the reference surface of the campaign."""
    yield from cloud_needs(campaign, subject)
    yield _REFERENCE.of(Subject(subject.campaign))


def run(inputs: Inputs, parameters: DeviateParameters, progress: Progress) -> Iterator[Output]:
    """Lay all views on the reference surface by one rigid motion, and say by how much each pixel is off."""
    reference = inputs.read(_REFERENCE, REFERENCE_SURFACE)
    surface = triangle_surface(reference.vertices, reference.faces)
    progress(0.05, f"read {reference.filename}")
    views = [_view_of(view) for view in camera_views(inputs)]
    progress(0.3, "read the shape")
    registration = _registered(surface, views, parameters, inputs.threads)
    progress(0.6, f"registered in {registration.iterations} iterations")
    fields = {}
    for seen in views:
        fields[seen.view.camera] = _field(surface, seen, registration, parameters, inputs.threads)
        progress(0.6 + 0.3 * len(fields) / len(views), f"compared {seen.view.camera}")
    statistics = _statistics(fields, registration)
    products: dict[Product[Any], Any] = {DEVIATION.of(camera): field for camera, field in fields.items()}
    products[REGISTRATION] = _record(reference, registration)
    products[MESH] = _mesh(views, fields, parameters.mesh_step_px)
    yield DatasetOutput(inputs.subject, products, statistics)
    name = inputs.subject.in_filename
    for camera, field in fields.items():
        yield DocumentOutput(
            inputs.subject,
            _MAP,
            f"{name}-{camera}-deviation.png",
            partial(write_deviation_map, field),
        )


def _view_of(view: CameraView) -> _View:
    normals = image_normals(view.xyz, view.labels)
    known = (view.labels > 0) & np.isfinite(normals).all(axis=0)
    points = MeasuredPoints(view.xyz[:, known].T, normals[:, known].T, view.covariance[:, known])
    return _View(view, known, points)


def _registered(
    surface: TriangleSurface, views: list[_View], parameters: DeviateParameters, threads: int
) -> Registration:
    """Return the motion that lays all views together on the surface."""
    joined = MeasuredPoints(
        np.concatenate([v.points.xyz for v in views]),
        np.concatenate([v.points.normals for v in views]),
        np.concatenate([v.points.covariance for v in views], axis=1),
    )
    points = joined.some(parameters.registration_points)
    if parameters.start == "given":
        rotation = rotation_matrix(np.array(parameters.rotation_rad))
        start = Pose.from_arrays(rotation, np.array(parameters.translation_mm))
    else:
        start = coarse_registration(surface, points, threads=threads)
    if parameters.iterations == 0:
        return Registration(start, np.zeros((6, 6)), 1.0, 0.0, 0, 0.0, 6, 0, True)
    return register(surface, points, start, iterations=parameters.iterations, threads=threads)


def _field(
    surface: TriangleSurface,
    seen: _View,
    registration: Registration,
    parameters: DeviateParameters,
    threads: int,
) -> DeviationField:
    view, known = seen.view, seen.known
    found = deviations(
        surface,
        seen.points,
        registration.pose,
        registration.covariance,
        within_mm=parameters.within_mm,
        threads=threads,
    )
    deviation, sigma = np.full(known.shape, np.nan), np.full(known.shape, np.nan, np.float32)
    deviation[known], sigma[known] = found.deviation, found.sigma
    xyz = np.full(view.xyz.shape, np.nan)
    xyz[:, known] = found.xyz.T
    covariance = np.full(view.covariance.shape, np.nan, np.float32)
    covariance[:, known] = turn_covariance(registration.pose.matrix(), seen.points.covariance)
    reason = view.reason.copy()
    reason[~known & (reason == Reason.VALID)] = Reason.TOO_FEW_NEIGHBOURS
    reason[known & ~np.isfinite(deviation)] |= np.uint32(Reason.OFF_REFERENCE)
    limits = (parameters.lower_mm, parameters.upper_mm, parameters.coverage_factor)
    verdict = verdicts(deviation, sigma, *limits)
    return DeviationField(
        view.camera, view.views, *limits, deviation, sigma, verdict, xyz, covariance, reason
    )


def _record(reference: ReferenceSurface, found: Registration) -> SurfaceRegistration:
    return SurfaceRegistration(
        reference.filename,
        reference.file_sha256,
        found.pose.rotation,
        found.pose.translation,
        found.scale,
        found.rms_mm,
        found.points,
        found.used_fraction,
        found.held,
        found.iterations,
        found.converged,
        found.covariance,
    )


def _mesh(views: list[_View], fields: dict[str, DeviationField], step: int) -> Mesh:
    """Return one surface of all cameras in the frame of the reference surface, where there is a deviation."""
    surfaces, values = [], []
    for seen in views:
        field = fields[seen.view.camera]
        labels = np.where(np.isfinite(field.deviation), seen.view.labels, 0).astype(np.int32)
        pixels, faces = triangulate_image(labels, step)
        row, column = pixels.T
        surfaces.append((np.ascontiguousarray(field.position[:, row, column].T), faces))
        deviation, sigma = field.deviation[row, column], field.sigma[row, column].astype(np.float64)
        verdict = field.verdict[row, column].astype(np.float64)
        values.append(np.stack([deviation, sigma, deviation / sigma, verdict]))
    vertices, faces, camera, vertex = join_meshes(surfaces)
    at_vertices = [part[:, vertex[camera == k]] for k, part in enumerate(values)]
    names, units = zip(*_VALUES, strict=True)
    return Mesh(names, units, vertices, faces, np.concatenate(at_vertices, axis=1))


def _statistics(fields: dict[str, DeviationField], registration: Registration) -> dict[str, float]:
    """Return what people search by, of all cameras together."""
    deviation, sigma, verdict = (
        np.concatenate([getattr(f, name).reshape(-1) for f in fields.values()])
        for name in ("deviation", "sigma", "verdict")
    )
    found = statistics_of(deviation, sigma, verdict)
    percentiles = {
        f"deviation_p{f'{p:g}'.replace('.', '_')}_mm": value
        for p, value in zip(PERCENTILES, found.percentiles, strict=True)
    }
    return {
        "points": float(found.points),
        "deviation_mean_mm": found.mean,
        "deviation_rms_mm": found.rms,
        "deviation_standard_deviation_mm": found.standard_deviation,
        "deviation_minimum_mm": found.minimum,
        "deviation_maximum_mm": found.maximum,
        **percentiles,
        "deviation_sigma_median_mm": found.sigma_median,
        "within_fraction": found.within,
        "undecided_fraction": found.undecided,
        "outside_fraction": found.outside,
        "registration_rms_mm": registration.rms_mm,
        "registration_scale": registration.scale,
        "registration_held_directions": float(registration.held),
        "registration_converged": float(registration.converged),
    }


KIND = Kind(
    name="deviate",
    summary="the shape at a state against the campaign's reference surface: registration, deviation, verdict",
    version=1,
    scope=Scope.STATE,
    parameters=DeviateParameters,
    inputs=(*SHAPES.all, _REFERENCE),
    outputs=(DEVIATION.by("camera"), REGISTRATION, MESH, _MAP),
    needs=needs,
    run=run,
    context=cameras,
    in_pipeline=False,
)
