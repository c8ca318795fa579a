"""Cameras that look at the virtual rig."""

from __future__ import annotations

from sms_jobs.instruments.optical_drivers import CameraDriver, Surroundings
from sms_jobs.instruments.simulated.optics import SimulatedCamera
from sms_jobs.records.optical_instruments import SIMULATED, VirtualCamera


def connect(camera: VirtualCamera, place: Surroundings) -> SimulatedCamera:
    """Put a camera into the hall."""
    assert place.hall is not None
    return SimulatedCamera(camera.name, place.hall, camera.faults)


DRIVER = CameraDriver(SIMULATED, VirtualCamera, connect)
