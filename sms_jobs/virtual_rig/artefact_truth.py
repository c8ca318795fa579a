"""What is exactly true of a simulated calibration measurement: where an artefact stands, and a bar's spheres.

Nothing here is rendered or measured: places and images are exact to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.records.artefacts import BallBar
from sms_jobs.records.scene import Deformation, Scene, Simulation
from sms_jobs.records.sensors import Sensor
from sms_jobs.virtual_rig.artefacts import bar_centres
from sms_jobs.virtual_rig.deformations import carried_points, packed_chain
from sms_jobs.virtual_rig.light import sensor_named
from sms_jobs.virtual_rig.truth import exact_shape


@dataclass(frozen=True)
class TrueBar:
    """The spheres of a bar as they truly stand before a view.

    Attributes
    ----------
    centre
        (2, 3), centres of spheres 1 and 2 in the world, mm.
    camera_px, projector_px
        (2, 2), the images of the centres; NaN where there is no projector.
    seen_px
        (2,), how many pixels of the camera see the sphere, lit by the projector if there is one.
    """

    centre: Floats
    camera_px: Floats
    projector_px: Floats
    seen_px: Ints


def placed_points(scene: Scene, deformation: tuple[Deformation, ...], points: Floats) -> Floats:
    """Return where points of an artefact's frame (n, 3) lie in the world, (n, 3), mm."""
    return carried_points(packed_chain(deformation, scene.placement), np.asarray(points, dtype=np.float64))


def true_bar(simulation: Simulation, *, threads: int = 1) -> TrueBar:
    """Return the exact spheres of the bar in a simulated measurement.

    Raises
    ------
    InvalidInput
        When what stands there is no ball bar.
    """
    bar = simulation.scene.surface
    if not isinstance(bar, BallBar):
        raise InvalidInput(
            f"state {simulation.state} shows no ball bar but a {bar.shape}; name one that does"
        )
    centres = placed_points(simulation.scene, simulation.deformation, bar_centres(bar))
    images = {s.name: project(s.intrinsics, s.pose, centres) for s in _sensors_of(simulation)}
    projector_px = images.get(simulation.projector or "", np.full((2, 2), np.nan))
    shape = exact_shape(simulation, threads=threads)
    seen = np.bincount(shape.region[shape.lit], minlength=3)[1:3]
    return TrueBar(centres, images[simulation.camera], projector_px, seen)


def _sensors_of(simulation: Simulation) -> list[Sensor]:
    """Return the camera and, if there is one, the projector."""
    names = (simulation.camera, simulation.projector)
    return [sensor_named(simulation, name) for name in names if name is not None]
