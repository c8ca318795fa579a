"""Reconstruct: from the frames of one tuple to a point, its covariance and a reason for every pixel.

The default thresholds are in units of the noise that the camera's model predicts, so that they fit any
exposure. At a modulation of 5 sigma a phase scatters by 0.14 rad, and a step of the fringe orders of the
reverse exponential sequence by 0.35 rad, far from a half fringe. The phase error of a good pixel follows a
chi-square law, of which 99.9 % is kept for each orientation; a pixel that sees two surfaces has phases that
are not proportional to the density and fails. On the virtual top hat more than 98 % of the pixels that are
seen and lit pass all tests.

The outermost pixels of what passes are given up besides: their light comes in part from beside the surface,
and where a camera's centre ray just misses a lit edge they show a point of the wrong surface with all the
signs of a good one. On the virtual top hat of 512 px this costs 2-4 % of the pixels and takes the largest
error from 140 mm to 0.6 mm.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import (
    CALIBRATION,
    MEASUREMENT,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Parameters,
    Progress,
    Scope,
)
from sms_jobs.metrology.geometry.triangulation import Projector, Triangulation, camera_rays, triangulate
from sms_jobs.metrology.images.masks import (
    at_edge,
    high_phase_error,
    large_ray_gap,
    low_modulation,
    outside_box,
    phase_error_factor,
)
from sms_jobs.metrology.phase.phase_stepping import phase_sigma
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap
from sms_jobs.metrology.phase.texture_error import (
    TYPICAL,
    Blur,
    estimate_blur,
    log_gradient,
    texture_shift,
    textured_interior,
)
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import PhaseMaps, PointCloud
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Calibration, Role, Sensor, split_pair

_SLAB = 64  # rows that are unwrapped at a time: bounds the memory, whatever the number of frames

_BLUR_ROWS = 128  # rows that are enough to estimate the blur from
_TEXTURE_ROUNDS = 2  # the first takes the slope of omega from phases that the texture still disturbs

# Of good pixels 0.2 % fail by noise: four that touch each other do so once in many million images.
_SMALLEST_GAP = 4

Reasons = NDArray[np.uint32]
Floats = NDArray[np.float64]
Singles = NDArray[np.float32]


class ReconstructParameters(Parameters):
    """How phases become points, and which of them are trusted."""

    method: Literal["temporal-unwrapping"] = Field(
        "temporal-unwrapping",
        description="how the phase gradient is found; temporal unwrapping takes any unambiguous densities",
    )
    blur_px: float | None = Field(
        None,
        ge=0.0,
        description="standard deviation of the spot that a pixel sees, for the correction of the texture's "
        "error; found from the ray gaps if not given, 0 for no correction",
    )
    maximum_shift_px: float = Field(
        0.5,
        gt=0.0,
        description="how far off its centre a pixel's light may come from: beyond is the edge of a surface",
    )
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
    maximum_ray_gap_to_noise: float = Field(
        4.0, gt=0.0, description="largest gap between the rays in standard deviations from noise"
    )
    maximum_ray_gap_mm: float = Field(
        0.2,
        ge=0.0,
        description="gap between the rays, from calibration, that is accepted on top of the noise",
    )


def _needs(campaign: Campaign, subject: Subject) -> Iterable[Need]:
    yield Need("measurement", MEASUREMENT, subject)
    yield Need("calibration", CALIBRATION, subject)


def run(inputs: Inputs, parameters: ReconstructParameters, progress: Progress) -> Iterator[Output]:
    """Unwrap and triangulate a tuple slab by slab, and say of every pixel whether it can be trusted."""
    measurement = inputs.read("measurement", "measurement", Measurement)
    calibration = inputs.read("calibration", "calibration", Calibration)
    camera_name, projector_name = split_pair(inputs.subject.pair or "")
    camera = calibration.rig.sensor(camera_name)
    projector = calibration.rig.sensor(projector_name)
    if (camera.role, projector.role) != (Role.CAMERA, Role.PROJECTOR):
        raise InvalidInput(
            f"{inputs.subject} is not of a camera and a projector of rig {calibration.rig.name}"
        )
    _, rows, columns = measurement.frames.shape
    if (rows, columns) != (camera.rows, camera.columns):
        raise InvalidInput(
            f"the frames of {inputs.subject} are {columns} x {rows} px but {camera_name} is calibrated for "
            f"{camera.columns} x {camera.rows} px: choose the calibration of the camera that recorded them"
        )
    phase = _empty_phase(measurement, rows, columns)
    reason = np.zeros((rows, columns), np.uint32)
    for start in range(0, rows, _SLAB):
        stop = min(start + _SLAB, rows)
        _unwrap_slab(measurement, parameters, slice(start, stop), inputs.threads, phase, reason)
        progress(0.8 * stop / rows, f"unwrapped {stop} of {rows} rows")
    rays = _Rays(camera, projector, phase.orientations_rad, inputs.threads)
    blur = _correct_texture(rays, parameters, phase, reason)
    progress(0.9, "corrected for the texture")
    points = rays.meet(phase.omega, phase.omega_sigma)
    _mark_points(points, calibration, parameters, reason)
    cloud = _as_cloud(camera_name, projector_name, points, reason)
    progress(1.0, "triangulated")
    yield DatasetOutput(inputs.subject, {"cloud": cloud, "phase": phase}, _statistics(cloud, phase, blur))


def _empty_phase(measurement: Measurement, rows: int, columns: int) -> PhaseMaps:
    orientations = measurement.sequence.orientations_rad
    shape = (len(orientations), rows, columns)
    return PhaseMaps(
        orientations,
        omega=np.empty(shape),
        omega_sigma=np.empty(shape, np.float32),
        modulation=np.empty(shape, np.float32),
        phase_error=np.empty(shape, np.float32),
        mean_intensity=np.zeros((rows, columns), np.float32),
    )


def _unwrap_slab(
    measurement: Measurement,
    parameters: ReconstructParameters,
    rows: slice,
    threads: int,
    phase: PhaseMaps,
    reason: Reasons,
) -> None:
    """Fill the rows of `phase` and mark those pixels in `reason` whose phase cannot be trusted."""
    sequence = measurement.sequence
    frames = measurement.frames.rows(rows.start, rows.stop)
    count = len(sequence.densities) * sequence.steps
    for k in range(len(sequence.orientations_rad)):
        found = unwrap(
            frames[k * count : (k + 1) * count],
            sequence.densities,
            sequence.steps,
            full_scale=measurement.full_scale,
            gain=measurement.gain,
            read_noise=measurement.read_noise,
            threads=threads,
        )
        phase.omega[k, rows] = found.omega
        phase.omega_sigma[k, rows] = found.omega_sigma
        phase.modulation[k, rows] = found.modulation
        phase.phase_error[k, rows] = found.phase_error
        phase.mean_intensity[rows] += found.mean_intensity / len(sequence.orientations_rad)
        reason[rows] |= _phase_reasons(found, measurement, parameters)


def _phase_reasons(
    found: PhaseGradient, measurement: Measurement, parameters: ReconstructParameters
) -> Reasons:
    """Return the reasons for which the phases of one orientation are not to be trusted."""
    noise = np.sqrt(measurement.read_noise**2 + measurement.gain * found.mean_intensity)
    weakest = np.maximum(parameters.minimum_modulation_to_noise * noise, parameters.minimum_modulation_count)
    factors = np.array(
        [
            phase_error_factor(n, parameters.kept_by_phase_error)
            for n in range(len(measurement.sequence.densities) + 1)
        ]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = phase_sigma(noise, found.modulation, measurement.sequence.steps)
        limit = np.hypot(factors[found.fitted] * sigma, parameters.maximum_phase_error_rad)
    reason = np.zeros(noise.shape, np.uint32)
    _mark(reason, low_modulation(found.modulation, weakest), Reason.LOW_MODULATION)
    _mark(reason, high_phase_error(found.phase_error, limit), Reason.HIGH_PHASE_ERROR)
    _mark(reason, found.saturated, Reason.SATURATED)
    _mark(reason, found.ambiguous, Reason.AMBIGUOUS_UNWRAPPING)
    return reason


def _mark(reason: Reasons, where: NDArray[np.bool_], why: Reason) -> None:
    reason[where] |= np.uint32(why)


@dataclass(frozen=True)
class _Rays:
    """The rays of one pair: what triangulation needs besides the phase."""

    camera: Sensor
    projector: Sensor
    orientations: tuple[float, ...]
    threads: int

    def meet(self, omega: Floats, omega_sigma: Singles, every: int = 1) -> Triangulation:
        """Triangulate phase gradients (orientations, rows, columns) that are of `every`-th row."""
        camera, projector = self.camera, self.projector
        rays = camera_rays(camera.intrinsics, camera.pose, camera.rows, camera.columns)
        rays = np.ascontiguousarray(rays[::every])
        rays.setflags(write=False)  # as the table is: kernels are compiled for one kind of array
        return triangulate(
            camera.pose.centre(),
            rays,
            Projector(projector.intrinsics, projector.pose, projector.columns, projector.rows),
            self.orientations,
            omega,
            omega_sigma,
            threads=self.threads,
        )


def _correct_texture(
    rays: _Rays, parameters: ReconstructParameters, phase: PhaseMaps, reason: Reasons
) -> Blur:
    """Take the texture's error out of `phase.omega`, and put what may be left of it into its sigma.

    A pixel whose light comes from too far off its centre sees past the edge of a surface or a shadow.
    """
    usable = reason == Reason.VALID
    gradient = log_gradient(phase.modulation.mean(axis=0))
    telling = textured_interior(usable, gradient)
    corrected = phase.omega
    for _ in range(_TEXTURE_ROUNDS):
        shift = texture_shift(corrected, usable, gradient, rays.threads)
        blur = _blur(rays, parameters, phase, shift, telling)
        corrected = phase.omega - blur.variance * shift
    beside = usable & (blur.variance * np.hypot(gradient[0], gradient[1]) > parameters.maximum_shift_px)
    _mark(reason, beside, Reason.OUTSIDE_REGION)
    left = (blur.unexplained * blur.variance * shift).astype(np.float32)
    np.hypot(phase.omega_sigma, left, out=phase.omega_sigma)
    phase.omega[...] = corrected
    return blur


def _blur(
    rays: _Rays,
    parameters: ReconstructParameters,
    phase: PhaseMaps,
    shift: Floats,
    telling: NDArray[np.bool_],
) -> Blur:
    """Return the blur that is given, or that the ray gaps of some rows tell, or that is typical."""
    if parameters.blur_px is not None:
        return Blur(parameters.blur_px**2, TYPICAL.unexplained)
    if len(phase.orientations_rad) == 1:
        return TYPICAL
    every = max(len(telling) // _BLUR_ROWS, 1)
    omega, sigma = phase.omega[:, ::every].copy(), phase.omega_sigma[:, ::every].copy()
    before, after = rays.meet(omega, sigma, every), rays.meet(omega - shift[:, ::every], sigma, every)
    seen = telling[::every]
    change = after.ray_gap - before.ray_gap
    return estimate_blur(before.ray_gap[seen], before.ray_gap_sigma[seen], change[seen])


def _mark_points(
    points: Triangulation, calibration: Calibration, parameters: ReconstructParameters, reason: Reasons
) -> None:
    """Mark the pixels whose point cannot be trusted; one whose rays do not meet at all is out of volume."""
    outside = outside_box(points.xyz, calibration.volume.low, calibration.volume.high)
    nowhere = np.isnan(points.xyz[0]) & (reason & Reason.SATURATED == 0)
    _mark(reason, outside | nowhere, Reason.OUT_OF_VOLUME)
    apart = large_ray_gap(
        points.ray_gap,
        points.ray_gap_sigma,
        parameters.maximum_ray_gap_mm,
        parameters.maximum_ray_gap_to_noise,
    )
    _mark(reason, apart, Reason.LARGE_RAY_GAP)
    _mark(reason, at_edge(reason == Reason.VALID, _SMALLEST_GAP), Reason.OUTSIDE_REGION)


def _as_cloud(camera: str, projector: str, points: Triangulation, reason: Reasons) -> PointCloud:
    """Return the point cloud, NaN where there is a reason."""
    bad = reason != Reason.VALID
    for values in (points.xyz, points.covariance, points.ray_gap[None]):
        values[:, bad] = np.nan
    return PointCloud(camera, projector, points.xyz, points.covariance, points.ray_gap, reason)


def _statistics(cloud: PointCloud, phase: PhaseMaps, blur: Blur) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    valid = cloud.reason == Reason.VALID
    bright = (cloud.reason & (Reason.LOW_MODULATION | Reason.OUT_OF_VOLUME)) == 0
    statistics = {
        "valid_fraction": float(valid.mean()),
        "valid_fraction_of_lit": float(valid.sum() / max(bright.sum(), 1)),
        "blur_px": float(np.sqrt(blur.variance)),
    }
    if valid.any():
        sigma = np.sqrt(cloud.covariance[[0, 3, 5]][:, valid].sum(axis=0))
        statistics |= {
            "median_sigma_mm": float(np.median(sigma)),
            "ray_gap_rms_mm": float(np.sqrt(np.mean(np.square(cloud.ray_gap[valid], dtype=np.float64)))),
            "median_modulation_count": float(np.median(phase.modulation[:, valid])),
            "median_phase_error_rad": float(np.nanmedian(phase.phase_error[:, valid])),
        }
    return statistics


KIND = Kind(
    name="reconstruct",
    summary="shape from fringes: phase gradients, points, their covariance, and a reason for every gap",
    version=1,
    scope=Scope.TUPLE,
    parameters=ReconstructParameters,
    needs=_needs,
    run=run,
)
