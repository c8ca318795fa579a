"""What the rest of the program asks of instruments, whichever make they are."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.measurement import FringeSequence, Measurement


class Recorder(Protocol):
    """Cameras and projectors that record together."""

    def record(
        self, pair: str, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None
    ) -> Measurement:
        """Project a sequence with the pair's projector and record it with its camera.

        `dimming`, the size of the projector's image, is what every pattern is multiplied by, white too.
        The frames may be taken while they are asked for. Raises `InvalidInput` for a pair that the rig
        does not have.
        """
        ...
