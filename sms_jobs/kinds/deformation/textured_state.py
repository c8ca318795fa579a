"""One state as correlation sees it: its texture, its surface and its regions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters, edge_settings
from sms_jobs.kinds.kind import CALIBRATION, Inputs, Port
from sms_jobs.kinds.products import CALIBRATED, PHASE, SURFACE
from sms_jobs.kinds.shape.textures import filtered, white_texture
from sms_jobs.kinds.surface_ports import StatePorts, position_covariance
from sms_jobs.metrology.deformation.matching.correlation import Noise
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.images.masks import of_one_label
from sms_jobs.metrology.images.region_of_interest import inside_outlines, parse_outlines
from sms_jobs.metrology.images.segmentation import ContinuousRegions, in_order, label_regions, pixel_footprint
from sms_jobs.metrology.images.texture_extent import textured_pixels
from sms_jobs.records.fields import PhaseMaps, Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject

CALIBRATION_OF_SHAPE = Port("calibration", CALIBRATION, (CALIBRATED,))


@dataclass(frozen=True)
class TexturedState:
    """One state of the view.

    Attributes
    ----------
    texture, noise
        (rows, columns), filtered, and its noise.
    surface
        Of the state; of a camera alone that of the reference, whatever the state.
    regions
        Continuous pieces of what is measured and of interest.
    of_interest
        (rows, columns): which pixels may be in a region.
    interior
        (rows, columns): which have their region all round them.
    matched
        (rows, columns): pixels with one label are matched together, those of 0 not at all.
    pin_hole
        Of the camera in mm, where its noise moves the surface along its rays.
    """

    texture: NDArray[np.floating]
    noise: Noise
    surface: Surface
    regions: ContinuousRegions
    of_interest: NDArray[np.bool_]
    interior: NDArray[np.bool_]
    matched: NDArray[np.int32]
    pin_hole: tuple[float, float, float] | None = None

    @property
    def match_regions(self) -> NDArray[np.int32]:
        """Return the regions (rows, columns) to whose pixels matches are spread."""
        return self.regions.labels if self.surface.has_depth else self.matched

    def parted(self, labels: NDArray[np.int32], parameters: CorrelateParameters) -> TexturedState:
        """Return it with other regions (rows, columns), of which some have come apart."""
        regions = in_order(labels)
        if self.surface.has_depth:
            return self.with_regions(regions, parameters)
        return replace(self, regions=regions, matched=regions.labels)

    def with_regions(self, regions: ContinuousRegions, parameters: CorrelateParameters) -> TexturedState:
        """Return it with regions that end at discontinuities."""
        size = 2 * parameters.edge_margin_px + 1
        labels = regions.labels
        interior = of_one_label(labels, size) & (labels > 0)
        matched = np.where(interior, labels, 0).astype(np.int32)
        return replace(self, regions=regions, interior=interior, matched=matched)


def read_reference(inputs: Inputs, ports: StatePorts, parameters: CorrelateParameters) -> TexturedState:
    """Read the reference state, of which only what is of interest gets a region."""
    surface = inputs.read(ports.surface.port, SURFACE)
    shape = surface.reason.shape
    chosen = np.ones(shape, dtype=bool)
    if parameters.region_of_interest:
        chosen = pixels_of_interest(parameters.region_of_interest, shape, inputs.subject)
    return _state(inputs, ports, surface, parameters, chosen)


def pixels_of_interest(region: str, shape: tuple[int, int], subject: Subject) -> NDArray[np.bool_]:
    """Return which pixels (rows, columns) are of interest; `InvalidInput` where none is."""
    chosen = inside_outlines(parse_outlines(region), shape)
    if not chosen.any():
        raise InvalidInput(
            f"the region of interest '{region}' leaves no pixel of {subject}, whose image has "
            f"{shape[1]} x {shape[0]} px; give outlines inside it"
        )
    return chosen


def read_later(
    inputs: Inputs, ports: StatePorts, parameters: CorrelateParameters, before: TexturedState
) -> TexturedState:
    """Read a state that is compared with the reference."""
    if before.surface.has_depth:
        surface = inputs.read(ports.surface.port, SURFACE)
        return _state(inputs, ports, surface, parameters, np.ones(surface.reason.shape, dtype=bool))
    measurement = ports.recorded(inputs)
    shape, found = before.surface.reason.shape, measurement.texture.shape
    if found != shape:
        raise InvalidInput(
            f"the image of {inputs.subject} has {found[1]} x {found[0]} px, that of the reference state "
            f"{shape[1]} x {shape[0]} px; record both with one camera"
        )
    texture, noise = white_texture(measurement, parameters.smoothing_px, before.of_interest)
    # Nothing but its texture tells where the specimen has come to.
    level = noise.floor + noise.slope * texture
    seen = np.asarray(textured_pixels(texture, level, parameters.subset_radius_px))
    return _of_one_piece(texture, noise, before.surface, seen, seen)


def _state(
    inputs: Inputs,
    ports: StatePorts,
    surface: Surface,
    parameters: CorrelateParameters,
    chosen: NDArray[np.bool_],
) -> TexturedState:
    measured = surface.reason == Reason.VALID
    valid = measured & chosen
    texture, noise = read_texture(inputs, ports, parameters, measured, valid)
    whole = _of_one_piece(texture, noise, surface, valid, chosen)
    if not surface.has_depth:
        return replace(whole, matched=valid.astype(np.int32))
    sensor = inputs.read(CALIBRATION_OF_SHAPE, CALIBRATED).rig.sensor(surface.camera)
    if surface.own_noise is not None:
        x, y, z = sensor.pose.centre().tolist()
        whole = replace(whole, pin_hole=(x, y, z))
    if parameters.regions == "none":
        return whole
    regions = label_regions(
        surface.position,
        valid,
        np.sqrt(trace(position_covariance(surface))),
        pixel_footprint(surface.position, sensor.intrinsics, sensor.pose),
        minimum_area=parameters.minimum_region_area_px,
        edges=edge_settings(parameters),
        threads=inputs.threads,
    )
    return whole.with_regions(regions, parameters)


def _of_one_piece(
    texture: NDArray[np.floating],
    noise: Noise,
    surface: Surface,
    valid: NDArray[np.bool_],
    chosen: NDArray[np.bool_],
) -> TexturedState:
    """Return a state without discontinuities; without a shape subsets look at all that is of interest."""
    return TexturedState(texture, noise, surface, _one_region(valid), chosen, valid, chosen.astype(np.int32))


def read_texture(
    inputs: Inputs,
    ports: StatePorts,
    parameters: CorrelateParameters,
    measured: NDArray[np.bool_],
    of_interest: NDArray[np.bool_],
    about: Subject | None = None,
) -> tuple[NDArray[np.floating], Noise]:
    """Read the texture of a state, filtered, and its noise; of a camera alone there is but the white frame.

    `measured` and `of_interest`, (rows, columns), are the pixels with a shape and those whose noise it is;
    `about` says of what, where the ports have several.
    """
    measurement = ports.recorded(inputs, about)
    surface = ports.surface.port
    if parameters.texture == "white" or not inputs.has(surface, PHASE, about):
        return white_texture(measurement, parameters.smoothing_px, of_interest)
    phase = inputs.read(surface, PHASE, about)
    noise = average_noise(measurement, phase, measured)
    return filtered(phase.mean_intensity, noise, parameters.smoothing_px, of_interest)


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
    frames = measurement.sequence.averaged_frames
    read_variance, gain = measurement.read_noise**2 / frames, measurement.gain / frames
    if phase.exposure is None or not valid.any():
        return Noise(read_variance, gain)
    scale = 1.0 / phase.exposure[valid].astype(np.float64)
    level = phase.mean_intensity[valid]
    slope = float(np.mean(scale * level) / np.mean(level, dtype=np.float64))
    return Noise(read_variance * float(np.mean(scale**2)), gain * slope)
