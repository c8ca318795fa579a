"""What real cameras have in common, whichever driver reaches them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import DeviceFault, InvalidInput
from sms_jobs.instruments.protocols import CameraFacts
from sms_jobs.records.optical_instruments import CameraInstrument


@dataclass(frozen=True)
class RealCamera(CameraInstrument):
    """A camera that does not know its own noise.

    Attributes
    ----------
    noise_gain, read_noise
        Noise model in grey levels, of the camera's data sheet or of a photon transfer measurement:
        variance = read_noise^2 + noise_gain * grey level.
    """

    noise_gain: float
    read_noise: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0.0 < self.noise_gain < 1e4 and 0.0 <= self.read_noise < 1e4):
            raise InvalidInput(
                f"camera {self.name} has a noise gain of {self.noise_gain} and a read noise of "
                f"{self.read_noise} grey levels: the first must be above 0, the second not below, both under "
                "10000"
            )

    def facts(self, bits: int) -> CameraFacts:
        """Return what does not change about it, with grey levels of so many bits."""
        dtype = "uint8" if bits <= 8 else "uint16"
        return CameraFacts(self.columns, self.rows, dtype, 2**bits - 1, self.noise_gain, self.read_noise)


def checked_image(camera: str, image: NDArray[Any], facts: CameraFacts) -> NDArray[Any]:
    """Return an image that is what the rig file says of the camera.

    Raises
    ------
    DeviceFault
        When it has another size, or other grey levels.
    """
    if image.shape != (facts.rows, facts.columns):
        raise DeviceFault(
            f"camera {camera} delivers images of {image.shape[1]} x {image.shape[0]} pixels, the rig file "
            f"says {facts.columns} x {facts.rows}: correct one of them"
        )
    if image.dtype != np.dtype(facts.dtype):
        raise DeviceFault(
            f"camera {camera} delivers grey levels as {image.dtype}, the rig file says {facts.dtype}: "
            "correct its pixel format"
        )
    if image.size and (brightest := int(image.max())) > facts.full_scale:
        raise DeviceFault(
            f"camera {camera} delivers the grey level {brightest}, above the full scale "
            f"{facts.full_scale} of the rig file: give the bits that it really has"
        )
    return image
