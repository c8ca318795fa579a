"""What the frames of a tuple are turned into phases with, and why a pixel is not to be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from sms_jobs.kinds.parameters import Parameters
from sms_jobs.metrology.arrays import Floats, Mask, Reasons, Singles
from sms_jobs.metrology.calibration.checking.expected_gap import pixel_size
from sms_jobs.metrology.geometry.ray_pairing import AMPLITUDE_TOLERANCE
from sms_jobs.metrology.geometry.sensor_pair import SensorPair
from sms_jobs.metrology.images.masks import high_phase_error, low_modulation
from sms_jobs.metrology.phase.joint_fit import JointCode
from sms_jobs.metrology.phase.phase_stepping import phase_sigma
from sms_jobs.metrology.phase.ranging.signal import Window
from sms_jobs.metrology.phase.response import Response
from sms_jobs.metrology.phase.ripple_table import RippleTable
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Box
from sms_jobs.records.subject import Subject

Method = Literal["temporal-unwrapping", "fdr"]
UNWRAPPING: Method = "temporal-unwrapping"


class TrustParameters(Parameters):
    """Which phases are trusted, and how far rays may miss each other."""

    minimum_modulation_to_noise: float = Field(
        5.0, ge=0.0, description="least fringe modulation in standard deviations of the camera's noise"
    )
    minimum_modulation_count: float = Field(
        0.0, ge=0.0, description="least fringe modulation in grey levels, besides that"
    )
    kept_by_phase_error: float = Field(
        0.999,
        gt=0.0,
        lt=1.0,
        description="part of good pixels whose phase error from noise alone is accepted",
    )
    maximum_phase_error_rad: float = Field(
        0.02, ge=0.0, description="phase error of the fringes themselves that is accepted on top of the noise"
    )
    maximum_motion_px: float = Field(
        0.05,
        gt=0.0,
        description="shift of the image between the fringes of two densities that is accepted: beyond, the "
        "recording is refused",
    )
    maximum_ray_gap_to_noise: float = Field(
        4.0, gt=0.0, description="largest gap between the rays in standard deviations from noise"
    )
    calibration_sigma_px: float | None = Field(
        None,
        ge=0.0,
        description="standard deviation of the gap between the rays from the calibration, in pixels of the "
        "projector, or of the other camera; what the calibration says of itself if not given, 0.05 where it "
        "says nothing",
    )
    response: Literal["none", "measured"] = Field(
        "none",
        description="whether the ripple of a projector that is not linear is taken out: 'measured' finds it "
        "in the frames themselves and costs a second or two; 'none' leaves it, and states it as uncertainty",
    )


class PhaseParameters(TrustParameters):
    """How phases are found, and which of them are trusted."""

    method: Method = Field(
        "temporal-unwrapping",
        description="how the phase gradient is found: temporal unwrapping of any unambiguous densities, or "
        "Fourier domain ranging ('fdr') of several returns over the densities 0, 1, 2 ..",
    )
    returns: int = Field(1, ge=1, le=4, description="most returns that are looked for in a pixel")
    window: Window = Field("none", description="weights over the densities against leakage of strong returns")
    significance: float = Field(
        1e-4, gt=0.0, lt=1.0, description="probability at which noise alone is taken for one more return"
    )
    pair_rule: Literal["likelihood", "least-gap"] = Field(
        "likelihood",
        description="how returns of the orientations are paired: by gap, amplitudes and volume, close ones "
        "told apart by the amplitudes of another orientation; or by the least ray gap, as in the thesis",
    )
    minimum_pair_margin: float = Field(
        3.0,
        ge=0.0,
        description="log-likelihood by which the chosen pair must excel any pair of another place; 3 are "
        "odds of 20",
    )

    @field_validator("returns")
    @classmethod
    def _have_a_method(cls, returns: int, given: ValidationInfo) -> int:
        if returns > 1 and given.data.get("method") == UNWRAPPING:
            raise ValueError("temporal unwrapping finds only one return; set method=fdr to separate several")
        return returns


@dataclass(frozen=True)
class Geometry:
    """Where sensors and specimen are: by this returns are paired.

    Attributes
    ----------
    pair, volume
        Of the calibration.
    gap_sigma_px
        Standard deviation of the ray gap from the calibration, in pixels of the projector.
    """

    pair: SensorPair
    volume: Box
    gap_sigma_px: float

    def gap_sigma_mm(self, xyz: Floats) -> Singles:
        """Return the same in mm, (rows, columns), at points (3, rows, columns) in mm."""
        inner, pose = self.pair.projector.intrinsics, self.pair.projector.pose
        size = pixel_size((inner, pose), np.moveaxis(xyz, 0, -1))
        return np.asarray(self.gap_sigma_px * size, np.float32)


@dataclass(frozen=True)
class PhaseTask:
    """What the frames of a tuple are turned into phases with; only ranging needs the geometry."""

    subject: Subject
    measurement: Measurement
    parameters: PhaseParameters
    threads: int
    geometry: Geometry | None = None


@dataclass(frozen=True)
class Known:
    """What is known before the first slab, for each orientation.

    Attributes
    ----------
    transfers
        Modulation over the densities, for ranging.
    responses
        Of the projector; None where too few pixels tell it.
    ripples
        What the responses do to unwrapped gradients; as many, or none.
    corrected
        Whether that is to be taken out.
    codes
        What frames show whose densities share a modulation; empty for any others.
    amplitude_spread
        Relative standard deviation between a return's amplitudes in two orientations, beside noise.
    """

    transfers: list[Floats]
    responses: list[Response | None]
    ripples: list[RippleTable]
    corrected: bool
    codes: tuple[JointCode, ...] = ()
    amplitude_spread: float = AMPLITUDE_TOLERANCE


def noise_reasons(
    modulation: Singles,
    phase_error: Singles,
    factor: Floats | float,
    ripple: Floats | float,
    noise: Singles,
    steps: int,
    parameters: TrustParameters,
) -> Reasons:
    """Return where the modulation is too low or the phase error above `factor` times that of noise.

    On top of it goes what the projector's `ripple` is known to make of it, in rad: however the two add up.
    """
    weakest = np.maximum(parameters.minimum_modulation_to_noise * noise, parameters.minimum_modulation_count)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = phase_sigma(noise, modulation, steps)
        limit = np.hypot(factor * sigma, parameters.maximum_phase_error_rad) + ripple
    reason = np.zeros(noise.shape, np.uint32)
    mark(reason, low_modulation(modulation, weakest), Reason.LOW_MODULATION)
    mark(reason, high_phase_error(phase_error, limit), Reason.HIGH_PHASE_ERROR)
    return reason


def mark(reason: Reasons, where: Mask, why: Reason) -> None:
    """Add a reason to those of the pixels where it holds."""
    reason[where] |= np.uint32(why)
