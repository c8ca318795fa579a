"""Which points of a camera and a projector can be trusted, and the surface that they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import Inputs, Port
from sms_jobs.kinds.products import UNCERTAINTY
from sms_jobs.kinds.shape.phase_task import Geometry, TrustParameters, mark
from sms_jobs.metrology.arrays import Floats, Mask, Reasons, Singles
from sms_jobs.metrology.calibration.checking.expected_gap import expected_gap_px
from sms_jobs.metrology.calibration.pair_points import box_grid
from sms_jobs.metrology.compilation import in_row_blocks
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.geometry.sensor_pair import SensorPair
from sms_jobs.metrology.geometry.transforms import PACKED
from sms_jobs.metrology.geometry.triangulation import Triangulation
from sms_jobs.metrology.images.masks import at_edge, large_ray_gap, outside_box
from sms_jobs.metrology.images.segmentation import find_discontinuities, pixel_footprint
from sms_jobs.metrology.phase.texture_error import Blur, Corrected
from sms_jobs.metrology.surfaces.bend_error import half_laplacian
from sms_jobs.metrology.surfaces.mixed_pixels import (
    InverseDepths,
    between_surfaces,
    beyond_noise,
    inverse_depths,
)
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Calibration, Sensor
from sms_jobs.records.views import Role

# Of good pixels 0.2 % fail by noise: four that touch each other do so once in many million images.
_SMALLEST_GAP = 4
_UNSTATED_PX = 0.05
"""Ray gap from a calibration that says nothing of itself; one with residuals of 0.1 px has about that."""

LARGEST_SHIFT_PX = 0.5
"""How far off its centre a pixel's light may come from: beyond is the edge of a surface."""


def paired_sensors(
    inputs: Inputs, calibration: Calibration, measurement: Measurement
) -> tuple[Sensor, Sensor]:
    """Return the camera and the projector of a tuple, as they are calibrated.

    Raises `InvalidInput` where the tuple is not of such a pair, or the camera that recorded it another one.
    """
    camera_name, projector_name = inputs.view.camera, inputs.view.projector
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
    return camera, projector


def gap_sigma_px(inputs: Inputs, port: Port, parameters: TrustParameters, calibration: Calibration) -> float:
    """Return by how much the rays may miss each other because of the calibration, in partner's pixels."""
    if parameters.calibration_sigma_px is not None:
        return parameters.calibration_sigma_px
    if not inputs.has(port, UNCERTAINTY):
        return _UNSTATED_PX
    names = inputs.view.triangulating
    camera, partner = ((s.intrinsics, s.pose) for s in map(calibration.rig.sensor, names))
    places = box_grid(np.array(calibration.volume.low), np.array(calibration.volume.high), per_side=3)
    covariance = inputs.read(port, UNCERTAINTY).of(names)
    return expected_gap_px(camera, partner, covariance, places)


def mark_points(
    points: Triangulation,
    geometry: Geometry,
    parameters: TrustParameters,
    reason: Reasons,
    corrected: Corrected,
) -> None:
    """Mark the pixels whose point cannot be trusted; mend the others, and say what they may be off.

    One whose rays do not meet, or so flatly that its covariance is beyond all numbers, is out of volume. One
    whose light comes from beside it sees past an edge, or is the rim of a dark speckle: that is no edge. One
    of which that is doubtful counts where the surface goes on.
    """
    mark(reason, corrected.beside, Reason.OUTSIDE_REGION)
    pair, volume = geometry.pair, geometry.volume
    outside = outside_box(points.xyz, volume.low, volume.high)
    nowhere = ~np.isfinite(points.covariance).all(axis=0) & (reason & Reason.SATURATED == 0)
    mark(reason, outside | nowhere, Reason.OUT_OF_VOLUME)
    apart = large_ray_gap(
        points.ray_gap,
        points.ray_gap_sigma,
        geometry.gap_sigma_mm(points.xyz),
        parameters.maximum_ray_gap_to_noise,
    )
    mark(reason, apart, Reason.LARGE_RAY_GAP)
    within = _on_one_surface(points, pair, reason == Reason.VALID, corrected.beside | corrected.doubtful)
    mark(reason, corrected.doubtful & ~within, Reason.OUTSIDE_REGION)
    known = reason == Reason.VALID
    mark(reason, at_edge(known, _SMALLEST_GAP, within), Reason.OUTSIDE_REGION)
    seen = inverse_depths(points.xyz, points.covariance, known, pair.intrinsics, pair.pose)
    mixed = between_surfaces(seen, reason == Reason.VALID, pair.threads)
    mark(reason, mixed, Reason.BETWEEN_SURFACES)
    _straighten(points, pair, seen.without(mixed), reason == Reason.VALID, corrected.blur)


def _straighten(
    points: Triangulation, pair: SensorPair, seen: InverseDepths, asked: Mask, blur: Blur
) -> None:
    """Take the bend of the surface within a pixel out of points, and add to the covariance what they are off.

    Along the camera's rays: light of a pixel changes its phase, not its ray.
    """
    straight, left = _straightened(seen, pair, asked, blur)
    centre = pair.pose.centre()[:, None, None]

    def move(start: int, stop: int) -> None:
        rows = slice(start, stop)
        xyz, covariance, part = points.xyz[:, rows], points.covariance[:, rows], points.part[rows]
        ray = xyz - centre
        ray *= seen.inverse[rows] / straight[rows]
        np.add(ray, centre, out=xyz)
        ray *= left[rows] / straight[rows]
        before = _trace(covariance)
        for index, (one, other) in enumerate(PACKED):
            covariance[index] += (ray[one] * ray[other]).astype(np.float32)
        # What cancels between neighbours stays what it is.
        with np.errstate(invalid="ignore", divide="ignore"):
            np.multiply(part, before / _trace(covariance), out=part)

    in_row_blocks(move, len(straight), pair.threads)


def _straightened(seen: InverseDepths, pair: SensorPair, asked: Mask, blur: Blur) -> tuple[Floats, Floats]:
    """Return inverse depths without the surface's bend within a pixel, and what may be left of that.

    The latter as a standard deviation; both in as little memory as they take.
    """
    bend, left = half_laplacian(seen.inverse, seen.sigma, pair.threads)
    left *= blur.variance
    np.hypot(left, blur.variance_sigma * bend, out=left)
    bend *= blur.variance
    straight = np.subtract(seen.inverse, bend, out=bend)
    after = replace(seen, inverse=straight, sigma=np.hypot(seen.sigma, left))
    np.hypot(left, beyond_noise(after, asked, pair.threads), out=left)
    return straight, left


def _trace(covariance: Singles) -> Singles:
    return np.asarray(covariance[0] + covariance[3] + covariance[5])


def _on_one_surface(points: Triangulation, pair: SensorPair, known: Mask, beside: Mask) -> Mask:
    """Return those pixels whose light comes from beside where the surface goes on: rims of dark speckles."""
    if not beside.any():
        return beside
    apart = find_discontinuities(
        points.xyz,
        known | (beside & np.isfinite(points.xyz).all(axis=0)),
        np.sqrt(trace(points.covariance)),
        pixel_footprint(points.xyz, pair.intrinsics, pair.pose),
        threads=pair.threads,
    )
    return np.asarray(beside & ~apart)


def as_surface(view: str, points: Triangulation, reason: Reasons) -> Surface:
    """Return the surface, NaN where there is a reason."""
    bad = reason != Reason.VALID
    for values in (points.xyz, points.covariance, points.ray_gap[None], points.part[None]):
        values[:, bad] = np.nan
    return Surface(
        view, "mm", points.xyz, reason, points.covariance, points.ray_gap, texture_part=points.part
    )
