"""The projector's response from a sample of a tuple's own frames, for whoever diagnoses or corrects it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.shape.streaming import RowSample, some_rows
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.phase.phase_stepping import phase_sigma
from sms_jobs.metrology.phase.response import (
    Response,
    diagnose_response,
    gradient_ripple,
    phase_residual,
)
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.subject import Subject

_LEAST_PIXELS = 100
_CLEAN = 0.95  # of the pixels that were asked: the few others change nothing
_SIGNIFICANT = 3.0  # standard deviations of a harmonic below which there is none
_NEGLIGIBLE = 0.1  # of the noise: what adds less changes a standard deviation by less than 0.5 %


class SampleParameters(Parameters):
    """Which pixels are looked at, and what was sent to the projector."""

    visibility: float = Field(
        1.0, gt=0.0, le=1.0, description="visibility of the fringe patterns that were sent to the projector"
    )
    rows: int = Field(24, ge=1, description="rows of the image that are looked at, evenly spread")
    most_pixels: int = Field(20_000, ge=500, description="pixels that are looked at, at most")
    minimum_modulation_to_noise: float = Field(
        20.0, gt=0.0, description="least fringe modulation in standard deviations of the camera's noise"
    )
    maximum_phase_error_to_noise: float = Field(
        4.0,
        gt=0.0,
        description="phase error, over that from noise, above which a pixel sees more than one surface",
    )
    maximum_phase_error_rad: float = Field(
        0.4,
        ge=0.0,
        description="phase error that is accepted on top of the noise before the ripple is known: that of "
        "the ripple itself, 0.29 for three steps and an exponent of 2.2",
    )
    maximum_phase_error_left_rad: float = Field(
        0.02,
        ge=0.0,
        description="phase error that is accepted on top of the noise once the ripple is known",
    )


_ROUGH = SampleParameters(rows=6, most_pixels=500)


@dataclass(frozen=True)
class SampledResponse:
    """The response in each orientation's frames, and the pixels that it was estimated from.

    Attributes
    ----------
    responses
        Of each orientation.
    densities
        That were looked at, from 1 on.
    pixels
        (points, 2), x and y.
    omega
        (orientations, points), phase gradient as unwrapping finds it, rad.
    omega_sigma
        Median standard deviation of it in each orientation, rad.
    """

    responses: tuple[Response, ...]
    densities: tuple[float, ...]
    pixels: Floats
    omega: Floats
    omega_sigma: tuple[float, ...]


def sampled_response(
    subject: Subject,
    measurement: Measurement,
    parameters: SampleParameters,
    threads: int,
    sample: RowSample | None = None,
) -> SampledResponse:
    """Find the response in some rows of a measurement, in those of a sample if one is given.

    Raises
    ------
    MeasurementFailed
        When fewer than 100 pixels have clear fringes.
    """
    sequence = measurement.sequence
    densities = tuple(t for t in sequence.densities if t > 0)
    sample = sample or some_rows(measurement, parameters.rows)
    frames = [
        sample.frames[sequence.frames_of(k, uniform=False)] for k in range(len(sequence.orientations_rad))
    ]
    found = [_unwrapped(measurement, densities, one, threads) for one in frames]
    good = _thinned(_good(found, measurement, parameters), parameters.most_pixels)
    _refuse_few(good, subject)

    def responses_of(seen: Mask) -> tuple[Response, ...]:
        return tuple(
            diagnose_response(
                some[:, seen], densities, sequence.steps, one.omega[seen], parameters.visibility
            )
            for some, one in zip(frames, found, strict=True)
        )

    # The ripple hides the pixels that see two surfaces: they are let in, and told once it is known.
    responses, single = responses_of(good), good.copy()
    for some, one, response in zip(frames, found, responses, strict=True):
        left = phase_residual(some[:, good], densities, sequence.steps, one.omega[good], response)
        frame_noise = measurement.noise(one.mean_intensity[good])
        noise = phase_sigma(frame_noise, one.modulation[good], sequence.steps)
        limit = np.hypot(
            parameters.maximum_phase_error_to_noise * noise, parameters.maximum_phase_error_left_rad
        )
        single[good] &= left < limit
    if single.sum() < _CLEAN * good.sum():
        _refuse_few(single, subject)
        responses = responses_of(single)
    good = single
    omega = np.stack([one.omega[good] for one in found])
    row, column = np.nonzero(good)
    pixels = np.stack([column.astype(np.float64), sample.rows[row].astype(np.float64)], axis=-1)
    sigma = tuple(float(np.median(one.omega_sigma[good])) for one in found)
    return SampledResponse(responses, densities, pixels, omega, sigma)


def rough_response(
    subject: Subject, measurement: Measurement, threads: int, sample: RowSample | None = None
) -> SampledResponse | None:
    """Find the response from few pixels; None where it matters not or cannot be told.

    It matters where it moves phase gradients by a tenth of their own noise. It cannot be told of one
    density, of patterns of other people, nor where few pixels have clear fringes.
    """
    sequence = measurement.sequence
    foreign = sequence.joint or sequence.gray is not None or any(measurement.phase_offsets_rad)
    if foreign or len(set(sequence.densities) - {0}) < 2:
        return None
    try:
        few = None if sample is None else sample.thinned(_ROUGH.rows)
        found = sampled_response(subject, measurement, _ROUGH, threads, few)
    except MeasurementFailed:
        return None
    found = replace(found, responses=tuple(_significant(one) for one in found.responses))
    matters = any(
        np.abs(gradient_ripple(response, omega, found.densities, measurement.sequence.steps)).max()
        > _NEGLIGIBLE * sigma
        for response, omega, sigma in zip(found.responses, found.omega, found.omega_sigma, strict=True)
    )
    return found if matters else None


def _significant(response: Response) -> Response:
    """Return a response without the harmonics that are not told from noise."""
    told = np.abs(response.harmonics) > _SIGNIFICANT * response.sigma
    return replace(response, harmonics=np.where(told, response.harmonics, 0.0))


def _refuse_few(good: Mask, subject: Subject) -> None:
    """Raise where too few pixels are left."""
    if good.sum() < _LEAST_PIXELS:
        raise MeasurementFailed(
            f"only {int(good.sum())} of the pixels looked at in {subject} have clear fringes, and "
            f"{_LEAST_PIXELS} are needed to find the projector's response: look at more rows, or lower "
            "minimum_modulation_to_noise; to reconstruct without it, set response=none"
        )


def _unwrapped(
    measurement: Measurement, densities: tuple[float, ...], frames: NDArray[Any], threads: int
) -> PhaseGradient:
    return unwrap(
        frames,
        densities,
        measurement.sequence.steps,
        full_scale=measurement.full_scale,
        gain=measurement.gain,
        read_noise=measurement.read_noise,
        threads=threads,
    )


def _good(found: list[PhaseGradient], measurement: Measurement, parameters: SampleParameters) -> Mask:
    """Return the pixels with clear fringes of one surface and no saturated frame in every orientation."""
    good = np.ones(found[0].omega.shape, np.bool_)
    for one in found:
        noise = measurement.noise(one.mean_intensity)
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = phase_sigma(noise, one.modulation, measurement.sequence.steps)
            limit = np.hypot(
                parameters.maximum_phase_error_to_noise * sigma, parameters.maximum_phase_error_rad
            )
            good &= one.modulation > parameters.minimum_modulation_to_noise * noise
            good &= one.phase_error < limit
        good &= (one.fitted == one.fitted.max()) & ~one.ambiguous & np.isfinite(one.omega)
    return good


def _thinned(good: Mask, most: int) -> Mask:
    """Keep every n-th of the pixels, so that no more than `most` are left."""
    places = np.flatnonzero(good)
    kept = np.zeros(good.size, np.bool_)
    kept[places[:: -(-places.size // most) or 1]] = True
    return kept.reshape(good.shape)
