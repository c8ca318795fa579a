"""Projectors that light the virtual rig."""

from __future__ import annotations

from sms_jobs.instruments.optical_drivers import ProjectorDriver, Surroundings
from sms_jobs.instruments.simulated.optics import SimulatedProjector
from sms_jobs.records.optical_instruments import SIMULATED, VirtualProjector


def connect(projector: VirtualProjector, place: Surroundings) -> SimulatedProjector:
    """Put a projector into the hall."""
    assert place.hall is not None
    return SimulatedProjector(projector.name, place.hall, projector.settle_ms / 1e3)


DRIVER = ProjectorDriver(SIMULATED, VirtualProjector, connect)
