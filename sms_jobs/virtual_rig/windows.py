"""Which part of an image can show anything: all of it, or only what surrounds the spheres of a bar."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.geometry.camera import project
from sms_jobs.records.artefacts import BallBar
from sms_jobs.records.scene import Deformation, PanTilt, Rigid, Scene
from sms_jobs.virtual_rig.artefacts import bar_centres
from sms_jobs.virtual_rig.deformations import carried_points, packed_chain

_MARGIN_PX = 2.0
"""Distortion bends the straight edges of a box of some tens of pixels by far less than this."""


def image_windows(scene: Scene, deformation: tuple[Deformation, ...], camera: str) -> NDArray[np.int64]:
    """Return first and end row, first and end column, in pixels, of each part to look at, (n, 4).

    The windows of two spheres may overlap.
    """
    sensor = scene.rig.sensor(camera)
    whole = np.array([[0, sensor.rows, 0, sensor.columns]], dtype=np.int64)
    bar = scene.surface
    if not isinstance(bar, BallBar) or not all(isinstance(d, Rigid | PanTilt) for d in deformation):
        return whole
    centres = carried_points(packed_chain(deformation, scene.placement), bar_centres(bar))
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
    corners = project(sensor.intrinsics, sensor.pose, centres[:, None] + bar.radius_mm * signs)
    if not np.isfinite(corners).all():
        return whole  # a sphere reaches behind the camera
    low = np.floor(corners.min(axis=1) - _MARGIN_PX).astype(np.int64)
    high = np.ceil(corners.max(axis=1) + _MARGIN_PX).astype(np.int64) + 1
    size = np.array([sensor.columns, sensor.rows])
    low, high = np.clip(low, 0, size), np.clip(high, 0, size)
    return np.stack([low[:, 1], high[:, 1], low[:, 0], high[:, 0]], axis=-1)
