"""Whether frames that wait in memory have room there."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import psutil

from sms_jobs.errors import InvalidInput
from sms_jobs.instruments.protocols import CameraFacts

PART_OF_MEMORY = 0.5
"""Of what is free that waiting frames may take."""


def image_bytes(facts: CameraFacts) -> int:
    """Return how many bytes an image of a camera has."""
    return facts.rows * facts.columns * np.dtype(facts.dtype).itemsize


def require_memory(frames: int, bytes_each: Mapping[str, int], advice: str) -> None:
    """Raise `InvalidInput` where frames of cameras, by the bytes of an image, do not fit into memory."""
    needed = frames * sum(bytes_each.values())
    allowed = PART_OF_MEMORY * psutil.virtual_memory().available
    if needed > allowed:
        raise InvalidInput(
            f"{frames} frames of each of {', '.join(bytes_each)} wait in memory and need "
            f"{needed / 1e6:.0f} MB, and half of what is free are {allowed / 1e6:.0f} MB: {advice}"
        )
