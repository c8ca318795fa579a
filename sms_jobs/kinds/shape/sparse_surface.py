"""The surface of a camera and a projector, of several cameras, or of both, at some pixels only."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sms_jobs.kinds.kind import DatasetOutput, Inputs, Output, Port, Progress
from sms_jobs.kinds.products import CALIBRATED, SURFACE
from sms_jobs.kinds.shape import stereo, stereo_fringes
from sms_jobs.kinds.shape.direction_check import check_directions
from sms_jobs.kinds.shape.phase_task import Geometry, PhaseParameters, PhaseTask
from sms_jobs.kinds.shape.phases import find_phases, sensor_pair
from sms_jobs.kinds.shape.stereo_fringes import StereoFringesParameters
from sms_jobs.kinds.shape.stereo_parameters import StereoParameters
from sms_jobs.kinds.shape.trusted_points import (
    LARGEST_SHIFT_PX,
    as_surface,
    gap_sigma_px,
    mark_points,
    paired_sensors,
)
from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.deformation.strain.gauge_points import SparseSurface
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.images.segmentation import label_regions, pixel_footprint
from sms_jobs.metrology.phase.texture_error import correct_texture
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Sensor

_PARAMETERS = PhaseParameters()
_MATCHES_APART = 2
_LEAST_AREA = 30
"""Places of a region: a gauge's end is fitted to as many."""


def first_px(step: int) -> int:
    """Return the first pixel, of rows and of columns, that gets a position."""
    return step // 2


def sparse_surface(
    inputs: Inputs, port: Port, measurement: Measurement, step: int, progress: Progress
) -> Surface:
    """Return the points of every `step`-th pixel, (3, rows, columns) of those alone.

    Phases are found, checked and corrected for the texture at every pixel, as by `reconstruct`: that takes
    less time than reading the frames.

    Parameters
    ----------
    port
        Of the calibration.

    Raises
    ------
    InvalidInput
        The calibration is not of the sensors that recorded it.
    MeasurementFailed
        The frames are not what they are said to be.
    """
    calibration = inputs.read(port, CALIBRATED)
    camera, projector = paired_sensors(inputs, calibration, measurement)
    sequence, threads = measurement.sequence, inputs.threads
    pair = sensor_pair(camera, projector, sequence, threads)
    geometry = Geometry(pair, calibration.volume, gap_sigma_px(inputs, port, _PARAMETERS, calibration))
    found = find_phases(PhaseTask(inputs.subject, measurement, _PARAMETERS, threads, geometry), progress)
    phase, reason = found.maps, found.reason
    check_directions(inputs.subject, geometry, phase, reason == Reason.VALID)
    corrected = correct_texture(
        phase.omega,
        phase.omega_sigma,
        phase.modulation,
        reason == Reason.VALID,
        reason & Reason.LOW_MODULATION == 0,
        pair.meet,
        maximum_shift_px=LARGEST_SHIFT_PX,
        threads=threads,
    )
    chosen = slice(first_px(step), None, step)
    thinned = replace(geometry, pair=sensor_pair(thinned_sensor(camera, step), projector, sequence, threads))
    reason, corrected = np.ascontiguousarray(reason[chosen, chosen]), corrected.thinned(chosen)
    points = thinned.pair.meet(
        np.ascontiguousarray(phase.omega[:, chosen, chosen]),
        np.ascontiguousarray(phase.omega_sigma[:, chosen, chosen]),
        part=corrected.part,
    )
    mark_points(points, thinned, _PARAMETERS, reason, corrected)
    return as_surface(str(inputs.view), points, reason)


def sparse_stereo_surface(
    inputs: Inputs, parameters: StereoParameters, step: int, progress: Progress
) -> Surface:
    """Return the points of every `step`-th pixel of the reference camera, (3, rows, columns) of those alone.

    As `stereo` measures them, from matches `_MATCHES_APART` times as far apart, but no farther than a subset
    reaches, so that each pixel lies in one.

    Raises
    ------
    InvalidInput, MeasurementFailed
        As `stereo` does.
    """
    spacing = min(_MATCHES_APART * parameters.spacing_px, parameters.subset_radius_px)
    coarser = parameters.model_copy(update={"spacing_px": max(spacing, parameters.spacing_px)})
    return _thinned(stereo.run(inputs, coarser, progress), step)


def sparse_stereo_fringes_surface(inputs: Inputs, step: int, progress: Progress) -> Surface:
    """Return the points of every `step`-th pixel of the reference camera, as `stereo-fringes` measures them.

    Raises
    ------
    InvalidInput, MeasurementFailed
        As `stereo-fringes` does.
    """
    return _thinned(stereo_fringes.run(inputs, StereoFringesParameters(), progress), step)


def _thinned(measured: Iterable[Output], step: int) -> Surface:
    """Return every `step`-th pixel of the surface that a kind measures."""
    (output,) = measured
    assert isinstance(output, DatasetOutput)
    surface: Surface = output.products[SURFACE]
    chosen = slice(first_px(step), None, step)
    return Surface(
        surface.view,
        surface.unit,
        np.ascontiguousarray(surface.position[:, chosen, chosen]),
        np.ascontiguousarray(surface.reason[chosen, chosen]),
        np.ascontiguousarray(position_covariance(surface)[:, chosen, chosen], dtype=np.float32),
        subset_radius_px=surface.subset_radius_px,
    )


def with_regions(inputs: Inputs, port: Port, surface: Surface, step: int) -> SparseSurface:
    """Return a sparse surface with its continuous regions; `port` is that of the calibration."""
    camera = thinned_sensor(inputs.read(port, CALIBRATED).rig.sensor(surface.camera), step)
    covariance = np.asarray(surface.covariance)
    regions = label_regions(
        surface.position,
        surface.reason == Reason.VALID,
        np.sqrt(trace(covariance)),
        pixel_footprint(surface.position, camera.intrinsics, camera.pose),
        minimum_area=_LEAST_AREA,
        threads=inputs.threads,
    )
    return SparseSurface(
        surface.position, covariance, regions.labels, step, first_px(step), surface.subset_radius_px
    )


def thinned_sensor(camera: Sensor, step: int) -> Sensor:
    """Return a camera that has every `step`-th pixel of another one alone."""
    first, inner = first_px(step), camera.intrinsics
    return replace(
        camera,
        columns=len(range(first, camera.columns, step)),
        rows=len(range(first, camera.rows, step)),
        intrinsics=replace(
            inner,
            fx=inner.fx / step,
            fy=inner.fy / step,
            cx=(inner.cx - first) / step,
            cy=(inner.cy - first) / step,
        ),
    )
