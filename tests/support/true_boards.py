"""What is exactly true of a simulated measurement of a board: where its points stand and are seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.records.artefacts import Chessboard, CircleBoard, DotCylinder
from sms_jobs.records.scene import Simulation
from sms_jobs.records.sensors import Sensor
from sms_jobs.virtual_rig.artefact_truth import placed_points
from sms_jobs.virtual_rig.artefacts import board_normals, board_points
from sms_jobs.virtual_rig.light import sensor_named


@dataclass(frozen=True)
class TrueBoard:
    """The points of a board as they truly stand before a view.

    Attributes
    ----------
    place
        (n, 2), column and row of each point on the board.
    point
        (n, 3), where it is in the board's frame, mm.
    world
        (n, 3), where it is in the world, mm.
    camera_px, projector_px
        (n, 2), its image in either sensor: of a dot's centre, not the centre of its image; NaN where there is
        no projector.
    seen
        (n,), whether it lies within the images of the sensors and shows them its front.
    """

    place: NDArray[np.int32]
    point: Floats
    world: Floats
    camera_px: Floats
    projector_px: Floats
    seen: Mask


def true_board(simulation: Simulation) -> TrueBoard:
    """Return the exact points of the board in a simulated measurement.

    Raises
    ------
    InvalidInput
        When what stands there is no board.
    """
    board = simulation.scene.surface
    if not isinstance(board, CircleBoard | DotCylinder | Chessboard):
        raise InvalidInput(f"state {simulation.state} shows no board but a {board.shape}; name one that does")
    place, point = board_points(board)
    world = placed_points(simulation.scene, simulation.deformation, point)
    ahead = placed_points(simulation.scene, simulation.deformation, point + board_normals(board))
    images = {}
    seen = np.ones(len(place), np.bool_)
    for name in filter(None, (simulation.camera, simulation.projector)):
        sensor = sensor_named(simulation, name)
        images[sensor.name] = project(sensor.intrinsics, sensor.pose, world)
        faces = np.sum((ahead - world) * (sensor.pose.centre() - world), axis=1) > 0.0
        seen &= faces & _in_image(sensor, images[sensor.name])
    nowhere = np.full((len(place), 2), np.nan)
    projector_px = images.get(simulation.projector or "", nowhere)
    return TrueBoard(place, point, world, images[simulation.camera], projector_px, seen)


def _in_image(sensor: Sensor, pixels: Floats) -> Mask:
    inside = (pixels >= -0.5) & (pixels <= np.array([sensor.columns, sensor.rows]) - 0.5)
    return np.asarray(inside.all(axis=1))
