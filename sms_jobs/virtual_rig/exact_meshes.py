"""The exact displacement of a simulated specimen at the nodes of a mesh, as a calculation would give it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.joining.merging import join_meshes
from sms_jobs.metrology.surfaces.meshing import triangulate_image
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.scene import Simulation
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.truth import exact_truth


@dataclass(frozen=True)
class ExactMesh:
    """Nodes (n, 3) in mm at the reference state, triangles (m, 3), and displacement (n, 3) in mm."""

    nodes: Floats
    triangles: NDArray[np.int32]
    displacement: Floats


def exact_mesh(campaign: Campaign, label: str, step_px: int, threads: int = 1) -> ExactMesh:
    """Return what exactly happens by a state to the surface that the campaign's cameras see.

    Parameters
    ----------
    campaign
        On the virtual rig.
    label
        Of the state.
    step_px
        Distance of the nodes in the images.
    threads
        How many threads to use; the result does not depend on it.

    Raises
    ------
    InvalidInput
        The campaign is not on the virtual rig, has a camera alone, or has no such state.
    """
    scene, views = campaign.scene, campaign.shape_views
    if scene is None or not views:
        raise InvalidInput(
            f"campaign {campaign.name} is not measured in space on the virtual rig, so its exact "
            "displacement is not known; see 'sms campaign simulate' for those that are"
        )
    state = campaign.state(label)
    surfaces, moved = [], []
    first_of_each = {view.camera: view for view in map(view_of, reversed(views))}
    for view in first_of_each.values():
        rest, end = (Simulation.of(scene, view, s.deformation, s.label) for s in (campaign.reference, state))
        truth = exact_truth(rest, end, view.partners, threads=threads)
        labels = np.where(truth.shape.seen, truth.shape.region, 0).astype(np.int32)
        pixels, faces = triangulate_image(labels, step_px)
        row, column = pixels.T
        surfaces.append((np.ascontiguousarray(truth.shape.xyz[:, row, column].T), faces))
        moved.append(truth.displacement[:, row, column].T)
    nodes, triangles, which, vertex = join_meshes(surfaces)
    return ExactMesh(
        nodes, triangles, np.concatenate([part[vertex[which == k]] for k, part in enumerate(moved)])
    )
