"""The noise of a camera: how much of it there is."""

from __future__ import annotations

from dataclasses import dataclass

from sms_jobs.records.scene import CameraResponse


@dataclass(frozen=True)
class Noise:
    """The noise of a camera in grey levels: variance = read_noise^2 + gain * level."""

    full_scale: int
    gain: float
    read_noise: float

    @classmethod
    def of(cls, camera: CameraResponse) -> Noise:
        """Return the noise of a camera, without that of rounding."""
        full_scale = 2**camera.bits - 1
        gain = full_scale / camera.full_well
        return cls(full_scale, gain, camera.read_noise * gain)
