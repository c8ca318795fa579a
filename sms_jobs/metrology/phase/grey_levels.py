"""What the grey levels of a camera mean: where they end, and how they scatter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

Float = TypeVar("Float", bound=np.floating)


@dataclass(frozen=True)
class GreyLevels:
    """The grey levels of one camera.

    Attributes
    ----------
    full_scale
        Grey level from which on a frame is saturated.
    gain, read_noise
        Noise model in grey levels: variance = read_noise^2 + gain * grey level.
    """

    full_scale: int
    gain: float
    read_noise: float

    def variance(self, level: NDArray[Float]) -> NDArray[Float]:
        """Return the variance of one frame's noise at grey levels, an array of any shape."""
        return cast(NDArray[Float], self.read_noise**2 + self.gain * level)
