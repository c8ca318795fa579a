"""A small virtual room with simulated cameras and projectors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime

import pytest

from sms_jobs.instruments.clock import SimulatedClock
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.protocols import Channel
from sms_jobs.instruments.simulated.optics import Setting, SimulatedCamera, SimulatedProjector, VirtualRoom
from sms_jobs.records.optical_instruments import OpticalFault
from sms_jobs.records.sensors import Rig
from sms_jobs.virtual_rig.campaigns import Lens, aimed, small_plate

BEGUN = datetime(2026, 5, 4, 10, 0, tzinfo=UTC)


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock(BEGUN)


MakeRig = Callable[..., ConnectedRig]


@pytest.fixture
def make_rig(clock: SimulatedClock) -> MakeRig:
    scene = small_plate("plate")[1].scene
    assert scene is not None
    second = aimed("C2", 128, 96, Lens(7.0, -0.08, 0.1, 0.0, 0.0), (200.0, 60.0, 1230.0))
    scene = replace(scene, rig=Rig("virtual", (scene.rig.sensors[0], second, *scene.rig.sensors[1:])))

    def make(
        faults: dict[str, tuple[OpticalFault, ...]] | None = None, channels: dict[str, Channel] | None = None
    ) -> ConnectedRig:
        room = VirtualRoom(Setting(scene, "S00", ()), clock)
        names = [s.name for s in scene.rig.sensors]
        return ConnectedRig(
            "virtual",
            {n: SimulatedCamera(n, room, (faults or {}).get(n, ())) for n in names if n.startswith("C")},
            {n: SimulatedProjector(n, room, 0.05) for n in names if n.startswith("P")},
            clock,
            channels=channels or {},
            simulation=room.simulation,
        )

    return make
