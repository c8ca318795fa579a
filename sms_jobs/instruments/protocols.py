"""What the rest of the program asks of instruments, whichever make they are."""

from __future__ import annotations

from typing import Protocol

from sms_jobs.records.measurement import FringeSequence, Measurement


class Recorder(Protocol):
    """Cameras and projectors that record together."""

    def record(self, pair: str, sequence: FringeSequence) -> Measurement:
        """Project a sequence with the pair's projector and record it with its camera.

        The frames may be taken while they are asked for. Raises `InvalidInput` for a pair that the rig
        does not have.
        """
        ...
