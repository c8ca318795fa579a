"""Projectors that light the virtual rig."""

from __future__ import annotations

from sms_jobs.instruments.optical_drivers import DriverContext, ProjectorDriver
from sms_jobs.instruments.simulated.optics import SimulatedProjector
from sms_jobs.records.optical_instruments import SIMULATED, VirtualProjector


def connect(projector: VirtualProjector, context: DriverContext) -> SimulatedProjector:
    """Put a projector into the room."""
    assert context.room is not None
    settle_s = projector.settle_ms / 1e3
    return SimulatedProjector(projector.name, context.room, settle_s, projector.pulses, projector.faults)


DRIVER = ProjectorDriver(SIMULATED, VirtualProjector, connect)
