"""Which sensors see a measurement volume: what none of them sees cannot be measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import Camera
from sms_jobs.metrology.geometry.common_view import sees_some_of
from sms_jobs.records.sensors import Box, Sensor


def refuse_unseen(sensors: Sequence[Sensor], volume: Box, source: str) -> None:
    """Raise `InvalidInput` where no sensor sees anything of a volume."""
    blind = _blind(sensors, volume)
    if len(blind) == len(sensors):
        raise InvalidInput(
            f"no sensor of {source} sees anything of the volume {corners(volume)}: give corners in the frame "
            f"of the world, in mm, between which {', '.join(blind)} look"
        )


def remarks_on_blind(sensors: Sequence[Sensor], volume: Box) -> list[str]:
    """Say which sensors see nothing of a volume."""
    blind = _blind(sensors, volume)
    remark = (
        f"{', '.join(blind)}: nothing of the volume {corners(volume)} is in the image, so that nothing is "
        "measured there; are its corners in the frame of the world, in mm?"
    )
    return [remark] if blind else []


def _blind(sensors: Sequence[Sensor], volume: Box) -> list[str]:
    low, high = np.array(volume.low), np.array(volume.high)
    cameras = {s.name: Camera(s.intrinsics, s.pose, s.columns, s.rows) for s in sensors}
    return [name for name, camera in cameras.items() if not sees_some_of(camera, low, high)]


def corners(volume: Box) -> str:
    """Return where a volume lies, for people."""
    low, high = (", ".join(f"{x:g}" for x in corner) for corner in (volume.low, volume.high))
    return f"from {low} to {high} mm"
