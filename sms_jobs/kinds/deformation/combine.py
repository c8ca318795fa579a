"""Combine: what several positions of a rig measured of one state, as one surface (thesis section 6.2.3)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.deformation.align import ViewsParameters
from sms_jobs.kinds.kind import (
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    deformed_states,
)
from sms_jobs.kinds.products import ALIGNMENT, MESH
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.joining.common_frame import StrainedSurface, brought, differences
from sms_jobs.metrology.deformation.joining.merging import join_meshes
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.records.alignment import ViewAlignment
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.field_names import (
    DISPLACEMENT_LENGTH,
    DISPLACEMENT_SIGMA,
    DISPLACEMENT_XYZ,
    STRAIN_VALUES,
    sigma_of,
)
from sms_jobs.records.fields import Mesh
from sms_jobs.records.sizes import number_of
from sms_jobs.records.subject import Subject

_VALUES = (
    *((name, "mm") for name in DISPLACEMENT_XYZ),
    (DISPLACEMENT_LENGTH, "mm"),
    (DISPLACEMENT_SIGMA, "mm"),
    *((name, "1") for name in STRAIN_VALUES),
    *((sigma_of(name), "1") for name in STRAIN_VALUES),
    ("view", "1"),
    ("difference of views", "mm"),
)
"""Names and units of the values at the vertices; view 0 is the campaign's own."""


class CombineParameters(ViewsParameters):
    """Which campaigns are combined."""


_ALIGNED = Port("alignment", "align", (ALIGNMENT,))
_MERGED = Port("merged", "merge", (MESH,), several=True)


def _needs(campaign: Campaign, subject: Subject, parameters: CombineParameters) -> Iterable[Need]:
    yield _ALIGNED.of(Subject(subject.campaign))
    for name in (subject.campaign, *parameters.views):
        yield _MERGED.of(replace(subject, campaign=name))


def run(inputs: Inputs, parameters: CombineParameters, progress: Progress) -> Iterator[Output]:
    """Bring the surfaces of the other views into this campaign's frame, and join them with its own."""
    own = inputs.read(_MERGED, MESH)
    own_axis = _axis_of(own, inputs.subject.campaign)
    surfaces = [_surface(own)]
    alignments = _alignments(inputs)
    for view in parameters.views:
        lies = _of(alignments, view, inputs.subject.campaign)
        pose = Pose(lies.rotation, lies.translation_mm)
        there = inputs.read(_MERGED, MESH, replace(inputs.subject, campaign=view))
        axis = _axis_of(there, view)
        surfaces.append(brought(_surface(there), pose, own_axis, axis))
    progress(
        0.3, f"brought {number_of(len(parameters.views), 'view')} into the frame of {inputs.subject.campaign}"
    )
    apart, pairs = differences(surfaces)
    progress(0.6, f"compared {number_of(len(pairs), 'overlap')}")
    vertices, faces, view_of, vertex = join_meshes([(s.vertices, s.faces) for s in surfaces])
    values = [
        _values(surface, number, difference)[:, vertex[view_of == number]]
        for number, (surface, difference) in enumerate(zip(surfaces, apart, strict=True))
    ]
    names, units = zip(*_VALUES, strict=True)
    mesh = Mesh(names, units, vertices, faces, np.concatenate(values, axis=1), strain_axis=own.strain_axis)
    statistics = {"vertices": float(len(vertices)), "faces": float(len(faces))}
    for (a, b), both in pairs.items():
        between = f"{a}_{b}"
        difference, stated = np.sqrt(both.mean(axis=0))
        statistics |= {
            f"difference_rms_mm_{between}": float(difference),
            f"stated_difference_mm_{between}": float(stated),
            f"overlap_vertices_{between}": float(len(both)),
        }
    progress(1.0, f"joined {number_of(len(surfaces), 'view')}")
    yield DatasetOutput(inputs.subject, {MESH: mesh}, statistics)


def _axis_of(mesh: Mesh, campaign: str) -> Floats:
    """Return the x axis of the strain of a mesh in its own frame, (3,)."""
    if mesh.strain_axis is None:
        raise InvalidInput(
            f"the merged surface of {campaign} does not say along which axis its strain is: submit strain "
            "and merge of it again"
        )
    return np.array(mesh.strain_axis)


def _alignments(inputs: Inputs) -> dict[str, ViewAlignment]:
    """Return how other campaigns lie to this one, by their names."""
    found = (inputs.read(_ALIGNED, each) for each in inputs.each(_ALIGNED, ALIGNMENT))
    return {one.campaign: one for one in found}


def _of(alignments: dict[str, ViewAlignment], view: str, own: str) -> ViewAlignment:
    if view not in alignments:
        raise InvalidInput(
            f"campaign {view} is not aligned with {own}, only {', '.join(alignments)}: submit align with "
            "all the views that are to be combined"
        )
    return alignments[view]


def _surface(mesh: Mesh) -> StrainedSurface:
    values = dict(zip(mesh.value_names, mesh.values, strict=True))
    return StrainedSurface(
        mesh.vertices,
        mesh.faces,
        np.stack([values[name] for name in DISPLACEMENT_XYZ]),
        values[DISPLACEMENT_SIGMA],
        np.stack([values[name] for name in STRAIN_VALUES]),
        np.stack([values[sigma_of(name)] for name in STRAIN_VALUES]),
    )


def _values(surface: StrainedSurface, view: int, difference: Floats) -> Floats:
    """Return the values of `_VALUES` at the vertices of one view."""
    return np.concatenate(
        [
            surface.displacement,
            np.linalg.norm(surface.displacement, axis=0)[None],
            surface.sigma[None],
            surface.strain,
            surface.strain_sigma,
            np.full((1, len(surface.vertices)), float(view)),
            difference[None],
        ]
    )


KIND = Kind(
    name="combine",
    summary="one surface of this campaign's and other positions' views of a state, none of it doubled",
    version=2,
    scope=Scope.STATE,
    parameters=CombineParameters,
    inputs=(_ALIGNED, _MERGED),
    outputs=(MESH,),
    needs=_needs,
    run=run,
    subjects=deformed_states,
    in_pipeline=False,
)
