"""Cameras that look at the virtual rig."""

from __future__ import annotations

from sms_jobs.instruments.optical_drivers import CameraDriver, DriverContext
from sms_jobs.instruments.simulated.optics import SimulatedCamera
from sms_jobs.records.optical_instruments import SIMULATED, VirtualCamera


def connect(camera: VirtualCamera, context: DriverContext) -> SimulatedCamera:
    """Put a camera into the room."""
    assert context.room is not None
    return SimulatedCamera(camera.name, context.room, camera.faults)


DRIVER = CameraDriver(SIMULATED, VirtualCamera, connect)
