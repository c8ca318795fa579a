"""One state as correlation sees it: its texture, its shape, its regions, and what of them is of interest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.kinds.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.kind import MEASUREMENT, Inputs, Port
from sms_jobs.kinds.products import CLOUD, MEASURED, PHASE
from sms_jobs.metrology.deformation.correlation import Noise
from sms_jobs.metrology.images.region_of_interest import inside_outlines, parse_outlines
from sms_jobs.metrology.images.segmentation import ContinuousRegions, label_regions, pixel_footprint
from sms_jobs.metrology.images.smoothing import noise_after_smoothing, smooth
from sms_jobs.records.campaign import Subject
from sms_jobs.records.fields import PhaseMaps, PointCloud
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Sensor


@dataclass(frozen=True)
class TexturedState:
    """One state of the view: texture, the texture's noise, shape, regions, and which pixels may be in one."""

    texture: NDArray[np.floating]
    noise: Noise
    cloud: PointCloud
    regions: ContinuousRegions
    of_interest: NDArray[np.bool_]


class StatePorts(NamedTuple):
    """Where the shape of a state comes in, and its frames."""

    shape: Port
    frames: Port


def state_ports(shape: str, frames: str) -> StatePorts:
    """Return the ports of a state, by their names."""
    return StatePorts(Port(shape, "reconstruct", (CLOUD, PHASE)), Port(frames, MEASUREMENT, (MEASURED,)))


def interior_of(labels: NDArray[np.int32], parameters: CorrelateParameters) -> NDArray[np.bool_]:
    """Return which pixels have their region all round them, up to the edge margin, if there are regions."""
    if parameters.regions == "none":
        return np.asarray(labels > 0)
    size = 2 * parameters.edge_margin_px + 1
    same = ndimage.minimum_filter(labels, size) == ndimage.maximum_filter(labels, size)
    return np.asarray(same & (labels > 0))


def matched_labels(
    before: TexturedState, interior: NDArray[np.bool_], parameters: CorrelateParameters
) -> NDArray[np.int32]:
    """Return which pixels are matched together: those of a region, or, without regions, all of interest."""
    if parameters.regions == "none":
        return before.of_interest.astype(np.int32)
    return np.where(interior, before.regions.labels, 0).astype(np.int32)


def read_state(
    inputs: Inputs,
    ports: StatePorts,
    sensor: Sensor,
    parameters: CorrelateParameters,
    *,
    of_interest: bool,
) -> TexturedState:
    """Read one state, choose its texture and find its regions, all or those of interest."""
    cloud = inputs.read(ports.shape, CLOUD)
    chosen = np.ones(cloud.reason.shape, dtype=bool)
    if of_interest and parameters.region_of_interest:
        chosen = inside_outlines(parse_outlines(parameters.region_of_interest), cloud.reason.shape)
    measured = cloud.reason == Reason.VALID
    valid = measured & chosen
    smoothed, noise = read_texture(inputs, ports, parameters, measured, valid)
    if parameters.regions == "none":
        return TexturedState(smoothed, noise, cloud, _one_region(valid), chosen)
    regions = label_regions(
        cloud.xyz,
        valid,
        np.sqrt(cloud.covariance[[0, 3, 5]].sum(axis=0, dtype=np.float64)),
        pixel_footprint(cloud.xyz, sensor.intrinsics, sensor.pose),
        minimum_area=parameters.minimum_region_area_px,
        threads=inputs.threads,
    )
    return TexturedState(smoothed, noise, cloud, regions, chosen)


def read_texture(
    inputs: Inputs,
    ports: StatePorts,
    parameters: CorrelateParameters,
    measured: NDArray[np.bool_],
    of_interest: NDArray[np.bool_],
    about: Subject | None = None,
) -> tuple[NDArray[np.floating], Noise]:
    """Read the texture of a state, filtered, and its noise.

    `measured` and `of_interest`, (rows, columns), are the pixels with a shape and those whose noise it is;
    `about` says of what, where the ports have several.
    """
    measurement = inputs.read(ports.frames, MEASURED, about)
    if parameters.texture == "white":
        texture: NDArray[np.floating] = measurement.texture.astype(np.float64)
        noise = Noise(measurement.read_noise**2, measurement.gain)
    else:
        phase = inputs.read(ports.shape, PHASE, about)
        texture = phase.mean_intensity
        noise = average_noise(measurement, phase, measured)
    smoothed = smooth(texture, parameters.smoothing_px)
    factor = noise_after_smoothing(smoothed, of_interest, parameters.smoothing_px)
    return smoothed, Noise(noise.floor * factor, noise.slope * factor)


def _one_region(valid: NDArray[np.bool_]) -> ContinuousRegions:
    """Return all that has a shape as a single region."""
    if not valid.any():
        return ContinuousRegions(np.zeros(valid.shape, np.int32), np.zeros(0, np.int64), np.zeros((0, 2)))
    y, x = np.nonzero(valid)
    centroid = np.array([[x.mean(), y.mean()]])
    return ContinuousRegions(valid.astype(np.int32), np.array([valid.sum()]), centroid)


def average_noise(measurement: Measurement, phase: PhaseMaps, valid: NDArray[np.bool_]) -> Noise:
    """Return the noise of the mean over the fringe frames, whose grey levels are those at exposure 1.

    Where pixels have exposures of their own it is right for the valid ones together: too much for the dark
    ones and too little for a highlight, which has the short exposures.
    """
    frames = measurement.sequence.frames_per_exposure
    read_variance, gain = measurement.read_noise**2 / frames, measurement.gain / frames
    if phase.exposure is None or not valid.any():
        return Noise(read_variance, gain)
    scale = 1.0 / phase.exposure[valid].astype(np.float64)
    level = phase.mean_intensity[valid]
    slope = float(np.mean(scale * level) / np.mean(level, dtype=np.float64))
    return Noise(read_variance * float(np.mean(scale**2)), gain * slope)
