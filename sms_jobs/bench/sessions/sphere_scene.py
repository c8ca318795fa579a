"""Clouds of a ball bar before a wall, as a view of the virtual rig would measure them in each pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sms_jobs.kinds.recording.simulate import recipe
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.stage.pan_tilt_refinement import sphere_regions
from sms_jobs.metrology.geometry.triangulation import camera_rays
from sms_jobs.records.artefacts import BallBar
from sms_jobs.records.scene import Simulation
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.artefact_truth import true_bar
from sms_jobs.virtual_rig.sessions import BAR, calibration_session
from sms_jobs.virtual_rig.truth import exact_shape

NOISE_MM = 0.05
_WALL_MM = -400.0
"""Z of a wall behind the bar: most of what a camera sees is no sphere."""
_MARGIN_MM = 5.0


@dataclass(frozen=True)
class SphereScene:
    """What C1P1 measured of one pose.

    Attributes
    ----------
    points
        (3, rows, columns) in mm, with noise along the rays.
    camera_centre
        (3,) in mm.
    bar
        What to look for.
    centres
        (2, 3), where the spheres are.
    region
        (rows, columns), where the stage says that they are.
    """

    points: Floats
    camera_centre: Floats
    bar: BallBar
    centres: Floats
    region: Mask


def sphere_scenes(poses: int, seed: int) -> Iterator[SphereScene]:
    """Yield the first poses of thesis Table 3, seen by a camera of 1024 px."""
    session = calibration_session("spheres", "full")
    assert session.scene is not None
    generator = np.random.default_rng(seed)
    camera = session.scene.rig.sensor("C1")
    rays = camera_rays(camera.intrinsics, camera.pose, camera.rows, camera.columns)
    centre = camera.pose.centre()
    wall = centre[:, None, None] + np.moveaxis(
        rays * ((_WALL_MM - centre[2]) / rays[..., 2])[..., None], 2, 0
    )
    for state in [s for s in session.states if s.artefact == "bar"][:poses]:
        task = recipe(session, Subject(session.name, state.label))
        simulation = Simulation(task.scene, "C1", "P1", task.deformation, state.label)
        shape = exact_shape(simulation)
        points = np.where(np.isfinite(shape.xyz) & shape.lit, shape.xyz, wall)
        points += NOISE_MM * generator.standard_normal(points.shape[1:]) * np.moveaxis(rays, 2, 0)
        truth = true_bar(simulation)
        size = (camera.rows, camera.columns)
        region = sphere_regions(camera.intrinsics, camera.pose, size, truth.centre, BAR.radius_mm, _MARGIN_MM)
        yield SphereScene(points, centre, BAR, truth.centre, region)
