"""The phases of a tuple: frames slab by slab to phase gradients, and a reason for what cannot be trusted.

Of several exposures every pixel takes its best one, so that the camera's noise model holds for all that
follows; grey levels are put in units of exposure 1 at the end. Where the projector's response is to
be corrected it is found first, in a sample of the frames themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import Progress
from sms_jobs.kinds.shape.code_watch import check_code
from sms_jobs.kinds.shape.foreign_patterns import (
    check_stripes,
    coarse_gradient,
    joint_codes,
    offsets_of,
    refuse_foreign_patterns,
    stated_by_what_is_left,
    striped_gradient,
)
from sms_jobs.kinds.shape.frame_lines import FrameLines
from sms_jobs.kinds.shape.frame_watch import FramePatches, check_frames
from sms_jobs.kinds.shape.fringe_response import (
    SampledResponse,
    SampleParameters,
    rough_response,
    sampled_response,
)
from sms_jobs.kinds.shape.phase_task import UNWRAPPING, Known, PhaseParameters, PhaseTask, mark, noise_reasons
from sms_jobs.kinds.shape.ranged_phases import (
    amplitude_spread,
    range_slab,
    rows_that_tell,
    shares_amplitudes,
    transfers,
)
from sms_jobs.kinds.shape.streaming import exposed_slabs
from sms_jobs.kinds.shape.watched_frames import OtherLight
from sms_jobs.metrology.arrays import Floats, Mask, Reasons, Singles
from sms_jobs.metrology.geometry.sensor_pair import SensorPair
from sms_jobs.metrology.geometry.triangulation import Projector
from sms_jobs.metrology.images.masks import alone, narrowed, phase_error_factor
from sms_jobs.metrology.phase.joint_fit import JointCode, fit_jointly
from sms_jobs.metrology.phase.phase_stepping import phase_sigma
from sms_jobs.metrology.phase.response import Response
from sms_jobs.metrology.phase.ripple_table import RippleTable, ripple_table
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap
from sms_jobs.records.fields import PhaseMaps, ReturnMaps
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Sensor

Frames = NDArray[Any]


@dataclass(frozen=True)
class Phases:
    """What the frames of a tuple tell.

    Attributes
    ----------
    maps
        Phase gradients of the pair's light.
    returns
        All returns, if there can be several.
    reason
        (rows, columns): why a pixel is not to be trusted.
    response
        Of the projector, if it was corrected.
    light
        What frames hold besides their patterns and noise: that of neighbours is taken out of the phase
        gradients, the rest is in their deviations.
    """

    maps: PhaseMaps
    returns: ReturnMaps | None
    reason: Reasons
    response: SampledResponse | None
    light: OtherLight = OtherLight()


def find_phases(task: PhaseTask, progress: Progress) -> Phases:
    """Return the phases of a tuple, its returns if there can be several, and the pixels not to be trusted.

    Raises `MeasurementFailed` when the frames are not what they are said to be, or when the response is to be
    corrected and cannot be found, and `InvalidInput` for ranging without a geometry and for a wrong number of
    frames.
    """
    measurement, parameters = task.measurement, task.parameters
    if parameters.method != UNWRAPPING and task.geometry is None:
        raise InvalidInput(f"method={parameters.method} needs a calibration; set method={UNWRAPPING}")
    sequence = measurement.sequence
    corrected = parameters.response == "measured"
    if parameters.method != UNWRAPPING or corrected:
        refuse_foreign_patterns(task.subject, measurement, f"method={UNWRAPPING} with response=none")
    count, rows, columns = measurement.frames.shape
    if count != sequence.frames:
        raise InvalidInput(
            f"the recording of {task.subject} has {count} frames and its fringe sequence {sequence.frames}: "
            "correct the fringe sequence, or record again"
        )
    phase = PhaseMaps.unset(sequence.orientations_rad, rows, columns, bracketed=sequence.exposures != (1.0,))
    reason = np.zeros((rows, columns), np.uint32)
    returns = None
    if parameters.returns > 1:
        returns = ReturnMaps.unset(sequence.orientations_rad, parameters.returns, rows, columns)
    response = None
    if corrected:
        response = sampled_response(task.subject, measurement, SampleParameters(), task.threads)
    known = _known(task, response)
    patches = FramePatches(rows, columns)
    checked = sequence.gray is not None and bool(sequence.densities) and not sequence.joint
    lines = FrameLines(rows, columns) if checked else None
    for slab, frames, exposure in exposed_slabs(measurement, task.threads):
        if parameters.method == UNWRAPPING:
            _unwrap_slab(task, known, slab, frames, phase, reason)
        else:
            range_slab(task, known, slab, frames, phase, returns, reason)
        patches.take(slab, frames)
        if lines is not None:
            lines.take(slab, frames)
        del frames  # before the next slab is asked for: two of them are in memory, not three
        _at_exposure_one(slab, exposure, phase, returns)
        progress(0.8 * slab.stop / rows, f"found phases in {slab.stop} of {rows} rows")
    if known.codes:
        # Ambiguous pixels lie in lines along fringes; nothing tells the slope at what is left between two.
        mark(reason, alone(reason == Reason.VALID), Reason.AMBIGUOUS_UNWRAPPING)
        _state_what_is_left(measurement, known.codes, phase, reason == Reason.VALID)
    if sequence.striped:
        # Beyond an edge a pixel shows the stripe of a surface that its centre misses.
        lit = (reason & Reason.LOW_MODULATION) == 0
        mark(reason, lit & ~narrowed(lit, 3), Reason.OUTSIDE_REGION)
        check_stripes(task.subject, measurement, patches.stacked(), phase, reason == Reason.VALID)
        return Phases(phase, returns, reason, response)
    accepted = parameters.maximum_phase_error_rad + (_largest_ripple(known.ripples) if corrected else 0.0)
    doubt = None if lines is None else check_code(measurement, lines.stacked(), accepted, task.geometry)
    light = check_frames(
        task.subject,
        measurement,
        patches.stacked(),
        accepted,
        parameters.maximum_motion_px,
        ranged=parameters.method != UNWRAPPING,
        codes=known.codes,
        doubt=doubt,
    )
    light = _unexplained(light, measurement, known, phase, reason == Reason.VALID)
    account_for(light, measurement, phase, returns)
    return Phases(phase, returns, reason, response, light)


def _unexplained(
    light: OtherLight, measurement: Measurement, known: Known, phase: PhaseMaps, trusted: Mask
) -> OtherLight:
    """Return it without what the known response of the projector makes: corrected, or stated already."""
    densities = [t for t in measurement.sequence.densities if t]
    if not (any(light.excess) and known.ripples and len(densities) > 1 and trusted.any()):
        return light
    noise = _noise_at_exposure_one(measurement, phase)[trusted]
    left = []
    for k, excess in enumerate(light.excess):
        of_noise = phase_sigma(noise, phase.modulation[k, trusted], measurement.sequence.steps)
        ripple = known.ripples[k].expected_error(phase.omega[k, trusted]) / of_noise
        # Half of what harmonics leave in the plane is phase, and n - 1 of n parts of that are left over.
        share = 0.5 * len(densities) / (len(densities) - 1) * float(np.mean(np.square(ripple)))
        left.append(max(excess - share, 0.0))
    return replace(light, excess=tuple(left))


def _noise_at_exposure_one(measurement: Measurement, phase: PhaseMaps) -> Singles:
    """Return the noise of a grey level, (rows, columns), in units of the camera's own exposure."""
    exposure = 1.0 if phase.exposure is None else phase.exposure
    return np.asarray(measurement.noise(phase.mean_intensity * exposure) / exposure)


def account_for(
    light: OtherLight, measurement: Measurement, phase: PhaseMaps, returns: ReturnMaps | None
) -> None:
    """Take what neighbours of frames do to phase gradients out of them, and put the rest into their sigma.

    In place. What the neighbours do differs from pixel to pixel, and a mean is known: its scatter is in the
    deviations, as noise whose variance is `OtherLight.excess` times that of the camera's.
    """
    maps: list[tuple[NDArray[Any], Singles, Singles]] = [(phase.omega, phase.omega_sigma, phase.modulation)]
    if returns is not None:
        maps.append((returns.omega, returns.omega_sigma, returns.amplitude))
    if light.lag is not None:
        for k, (shift, scatter) in enumerate(zip(light.lag.shift, light.lag.scatter, strict=True)):
            for omega, sigma, _ in maps:
                omega[k] -= shift
                np.hypot(sigma[k], np.float32(scatter), out=sigma[k])
    if not any(light.excess):
        return
    noise, steps = _noise_at_exposure_one(measurement, phase), measurement.sequence.steps
    squares = sum(t**2 for t in measurement.sequence.densities)
    for k, excess in enumerate(light.excess):
        for _, sigma, modulation in maps if excess else ():
            with np.errstate(divide="ignore", invalid="ignore"):
                more = np.float32(np.sqrt(excess / squares)) * phase_sigma(noise, modulation[k], steps)
                np.hypot(sigma[k], more, out=sigma[k])


def _known(task: PhaseTask, response: SampledResponse | None) -> Known:
    """Return what is known before the first slab: of the response roughly where it is not to be corrected."""
    sequence = task.measurement.sequence
    ranging = task.parameters.method != UNWRAPPING
    shared = ranging and shares_amplitudes(task.parameters)
    rows = rows_that_tell(task.measurement) if shared or (ranging and response is None) else None
    sample = response or rough_response(task.subject, task.measurement, task.threads, rows)
    ripples: list[RippleTable] = []
    responses: list[Response | None] = [None] * len(sequence.orientations_rad)
    if sample is not None:
        ripples = [ripple_table(one, sample.densities, sequence.steps) for one in sample.responses]
        responses = list(sample.responses)
    ranged: list[Floats] = []
    if ranging and response is not None:
        ranged = [np.array([one.at_density(t)[0] for t in sequence.densities]) for one in response.responses]
    elif rows is not None:
        ranged = transfers(task, rows)
    known = Known(ranged, responses, ripples, response is not None, joint_codes(task.measurement))
    if rows is None or not shared:
        return known
    spread = amplitude_spread(task, rows, ranged, responses if known.corrected else None)
    return replace(known, amplitude_spread=spread)


def _largest_ripple(ripples: list[RippleTable]) -> float:
    """Return the largest phase error, in rad, that harmonics are known to make; 0 where nothing is known."""
    return max((float(table.residual.max()) for table in ripples), default=0.0)


def _at_exposure_one(rows: slice, exposure: Singles, phase: PhaseMaps, returns: ReturnMaps | None) -> None:
    """Put the grey levels of a slab in units of the camera's own exposure."""
    phase.modulation[:, rows] /= exposure
    phase.mean_intensity[rows] /= exposure
    if phase.exposure is not None:
        phase.exposure[rows] = exposure
    if returns is not None:
        returns.amplitude[:, :, rows] /= exposure


def _unwrap_slab(
    task: PhaseTask, known: Known, rows: slice, frames: Frames, phase: PhaseMaps, reason: Reasons
) -> None:
    """Fill the rows of `phase` and mark those pixels in `reason` whose phase cannot be trusted."""
    measurement, parameters = task.measurement, task.parameters
    sequence = measurement.sequence
    for k in range(len(sequence.orientations_rad)):
        fringes = frames[sequence.frames_of(k, uniform=False)]
        found = (
            striped_gradient(measurement, k, frames)
            if sequence.striped
            else _gradient(task, known, k, frames, fringes)
        )
        phase.omega[k, rows] = found.omega
        phase.omega_sigma[k, rows] = found.omega_sigma
        ripple: Floats | float = 0.0
        if known.corrected:
            table = known.ripples[k]
            phase.omega[k, rows] = table.corrected(found.omega)
            phase.omega_sigma[k, rows] = table.corrected_sigma(found.omega, found.omega_sigma)
            ripple = table.expected_error(found.omega)
        elif known.ripples:
            left = found.omega - known.ripples[k].corrected(found.omega)
            phase.omega_sigma[k, rows] = np.hypot(found.omega_sigma, left)
        phase.modulation[k, rows] = found.modulation
        phase.phase_error[k, rows] = found.phase_error
        phase.mean_intensity[rows] += found.mean_intensity / len(sequence.orientations_rad)
        reason[rows] |= _phase_reasons(found, ripple, measurement, parameters)


def _gradient(
    task: PhaseTask, known: Known, orientation: int, frames: Frames, fringes: Frames
) -> PhaseGradient:
    """Return the phase gradient of some rows, from the fringes of one orientation without the density 0."""
    measurement = task.measurement
    sequence = measurement.sequence
    if known.codes:
        return fit_jointly(fringes, known.codes[orientation], measurement.grey_levels, task.threads)
    return unwrap(
        fringes,
        tuple(t for t in sequence.densities if t),
        sequence.steps,
        full_scale=measurement.full_scale,
        gain=measurement.gain,
        read_noise=measurement.read_noise,
        offsets=offsets_of(measurement),
        coarse=coarse_gradient(measurement, orientation, frames),
        threads=task.threads,
    )


def _state_what_is_left(
    measurement: Measurement, codes: tuple[JointCode, ...], phase: PhaseMaps, trusted: Mask
) -> None:
    """Put what the model of a joint sequence leaves beyond noise into the sigma of the trusted pixels."""
    level = measurement.noise(phase.mean_intensity[trusted])
    for k, code in enumerate(codes):
        noise = phase_sigma(level, phase.modulation[k, trusted], code.steps)
        error, sigma = phase.phase_error[k, trusted], phase.omega_sigma[k, trusted]
        phase.omega_sigma[k, trusted] = stated_by_what_is_left(sigma, error, noise, code)


def _phase_reasons(
    found: PhaseGradient, ripple: Floats | float, measurement: Measurement, parameters: PhaseParameters
) -> Reasons:
    """Return the reasons for which the phases of one orientation are not to be trusted."""
    most = int(found.fitted.max())
    factors = np.array([phase_error_factor(n, parameters.kept_by_phase_error) for n in range(most + 1)])
    reason = noise_reasons(
        found.modulation,
        found.phase_error,
        factors[found.fitted],
        ripple,
        measurement.noise(found.mean_intensity),
        measurement.sequence.anchor_steps,
        parameters,
    )
    mark(reason, found.saturated, Reason.SATURATED)
    mark(reason, found.ambiguous, Reason.AMBIGUOUS_UNWRAPPING)
    return reason


def sensor_pair(camera: Sensor, projector: Sensor, sequence: FringeSequence, threads: int) -> SensorPair:
    """Return a pair as its calibration says it stands."""
    return SensorPair(
        camera.intrinsics,
        camera.pose,
        camera.rows,
        camera.columns,
        Projector(projector.intrinsics, projector.pose, projector.columns, projector.rows),
        sequence.orientations_rad,
        threads,
    )
