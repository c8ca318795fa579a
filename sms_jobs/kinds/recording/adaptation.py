"""What a quick pre-exposure tells of how bright every pixel is, and how to record it in range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Literal, TypeAlias

import numpy as np

from sms_jobs.errors import MeasurementFailed
from sms_jobs.instruments.recording_sets import Patterns
from sms_jobs.kinds.shape.streaming import exposed_slabs
from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.geometry.projector_pixels import projector_pixels
from sms_jobs.metrology.phase.exposure import exposure_set, projector_dimming
from sms_jobs.metrology.phase.temporal_unwrapping import unwrap
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.optical_instruments import ImageFormat

QUICK = FringeSequence((16, 15), 3, exposures=(1.0 / 64.0, 1.0 / 8.0, 1.0))
"""36 frames: phases good to a fraction of a projector pixel, of highlights up to 64 times too bright."""

_LEAST_MODULATION_TO_NOISE = 5.0
_REACH_PX = 4  # projector pixels over which dimming is made smooth, at least
_OVERLAP = 1.5  # and how far past the next camera pixel's light


Adaptive: TypeAlias = Literal["none", "exposures", "projector"]


@dataclass(frozen=True)
class Outlook:
    """What a pre-exposure shows of every camera pixel.

    Attributes
    ----------
    brightness
        (rows, columns), grey level of white at the camera's own exposure; infinite where the shortest
        exposure is too long, NaN where nothing is lit.
    projector_xy
        (rows, columns, 2), projector pixel that lights it, NaN where that is not known.
    full_scale
        Grey level at which the camera saturates.
    projector
        Whose light it is.
    """

    brightness: Floats
    projector_xy: Floats
    full_scale: int
    projector: ImageFormat

    def dimming(self, exposure: float) -> Singles:
        """Return factors for the projector's pixels, (rows, columns), so that one exposure serves all."""
        factor = projector_dimming(
            exposure * self.brightness,
            self.projector_xy,
            self.projector.columns,
            self.projector.rows,
            self.full_scale,
            reach=self._reach(),
        )
        return factor.astype(np.float32)

    def _reach(self) -> int:
        """Return how far the light of neighbouring camera pixels is apart on the projector, in whole px."""
        apart = np.abs(np.diff(self.projector_xy, axis=1)).max(axis=-1)
        return max(_REACH_PX, ceil(_OVERLAP * float(np.nanmedian(apart))))


def outlook(measurement: Measurement, projector: ImageFormat, threads: int) -> Outlook:
    """Return what a recording of `QUICK` shows.

    White is as bright as the fringes' mean and modulation together. Raises `MeasurementFailed` where nothing
    is lit.
    """
    sequence = measurement.sequence
    _, rows, columns = measurement.frames.shape
    brightness, xy = np.zeros((rows, columns)), np.empty((rows, columns, 2))
    for slab, frames, exposure in exposed_slabs(measurement, threads):
        found = [
            unwrap(
                frames[sequence.frames_of(k)],
                sequence.densities,
                sequence.steps,
                full_scale=measurement.full_scale,
                gain=measurement.gain,
                read_noise=measurement.read_noise,
                threads=threads,
            )
            for k in range(len(sequence.orientations_rad))
        ]
        for one in found:
            lit = one.modulation > _LEAST_MODULATION_TO_NOISE * measurement.noise(one.mean_intensity)
            white = np.where(lit, (one.mean_intensity + one.modulation) / exposure, np.nan)
            brightness[slab] = np.maximum(brightness[slab], np.where(one.saturated, np.inf, white))
        places, _ = projector_pixels(
            np.stack([one.omega for one in found]),
            np.stack([one.omega_sigma for one in found]),
            sequence.orientations_rad,
            projector.columns,
            projector.rows,
        )
        xy[slab] = np.moveaxis(places, 0, -1)
        del frames
    xy[~np.isfinite(brightness)] = np.nan
    if not np.isfinite(xy).any():
        raise MeasurementFailed(
            f"no pixel is lit by {projector.name} and in the camera's range in the pre-exposure: check the "
            "lens cap and the projector, or record with adaptive=none"
        )
    return Outlook(brightness, xy, measurement.full_scale, projector)


def adapted(
    adaptive: Adaptive,
    longest: float,
    sequence: FringeSequence,
    projector: ImageFormat,
    quick: Sequence[Measurement],
    threads: int,
) -> Patterns:
    """Return what a projector is to show so that all pixels of all cameras that look on are in range.

    Parameters
    ----------
    adaptive
        What is adapted: the exposures of the sequence, or where the projector is dimmed.
    longest
        Exposure that an adapted set does not exceed, in units of the camera's own.
    sequence
        As it is planned.
    quick
        What each camera has recorded of `QUICK`.
    """
    seen = [outlook(one, projector, threads) for one in quick]
    if adaptive == "exposures":
        # One set of exposures serves the pixels of all cameras, each in its own grey levels.
        full_scale = seen[0].full_scale
        bright = [(one.brightness * (full_scale / one.full_scale)).ravel() for one in seen]
        chosen = exposure_set(np.concatenate(bright), full_scale, longest=longest)
        return Patterns(replace(sequence, exposures=chosen))
    dimmed = [one.dimming(max(sequence.exposures)) for one in seen]
    return Patterns(sequence, np.minimum.reduce(dimmed))


def adaptation_statistics(measurement: Measurement) -> dict[str, float]:
    """Return how the exposure of a measurement was adapted, as people search by."""
    exposures = measurement.sequence.exposures
    found = {"exposures": float(len(exposures)), "shortest_exposure": min(exposures)}
    if measurement.dimming is not None:
        found["dimmed_fraction"] = float(np.mean(measurement.dimming < 1.0))
    return found
