"""The plate and mirror of thesis section 7.3.1 on the virtual rig, and how far measured points lie off it.

The plane is fitted to what is lit once: points that several returns have moved all together count as errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from sms_jobs.bench.fringes.peeling import peel_returns
from sms_jobs.kinds.shape.phase_task import PhaseTask
from sms_jobs.kinds.shape.phases import sensor_pair
from sms_jobs.kinds.shape.ranged_phases import rows_that_tell, transfers
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.geometry.ray_pairing import CandidateReturns, PairingRule
from sms_jobs.metrology.images.masks import outside_box
from sms_jobs.metrology.phase.sequences import reverse_exponential
from sms_jobs.metrology.phase.texture_error import correct_texture
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Simulation
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.virtual_rig.campaigns import START, Size, plate_and_mirror
from sms_jobs.virtual_rig.light import SUBSAMPLES, trace
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import exact_shape

SUBJECT = Subject("plate-and-mirror", "S00", "C1P1")
_MARGIN = 5  # px from the edges of plate and light: the thesis's regions of interrogation keep off them too


@dataclass(frozen=True)
class Plate:
    """A recorded plate, and which of its pixels are lit how often.

    Attributes
    ----------
    calibration, measurement
        The exact rig, and the frames.
    once, twice
        (rows, columns): lit by the projector alone, and by way of the mirror besides.
    hinge_mm
        (rows, columns): distance from the hinge along the plate.
    """

    calibration: Calibration
    measurement: Measurement
    once: Mask
    twice: Mask
    hinge_mm: Floats

    def points(self, parameters: dict[str, Any], threads: int) -> Surface:
        """Reconstruct the plate with some parameters of the kind."""
        records = {"measurement": self.measurement, "calibration": self.calibration}
        output = run_kind(KIND, SUBJECT, records, threads, ReconstructParameters(**parameters))
        cloud: Surface = output.records["surface"]
        return cloud

    def peeled(self, refinements: int, threads: int) -> Surface:
        """Reconstruct the plate by peeling, pairs by the least ray gap, masked by volume and modulation."""
        measurement, sequence, volume = self.measurement, self.measurement.sequence, self.calibration.volume
        camera, projector = (self.calibration.rig.sensor(name) for name in ("C1", "P1"))
        pair = sensor_pair(camera, projector, sequence, threads)
        task = PhaseTask(SUBJECT, measurement, ReconstructParameters(), threads)
        rows = measurement.frames.shape[1]
        frames = measurement.frames.rows(0, rows)
        found = [
            peel_returns(
                frames[sequence.frames_of(k)],
                sequence.densities,
                sequence.steps,
                measurement.grey_levels,
                returns=2,
                refinements=refinements,
                mtf=transfer,
            )
            for k, transfer in enumerate(transfers(task, rows_that_tell(measurement)))
        ]
        candidates = CandidateReturns(
            np.stack([f.omega for f in found]),
            np.stack([f.omega_sigma for f in found]).astype(np.float32),
            np.stack([f.amplitude for f in found]).astype(np.float32),
        )
        density_rms = float(np.sqrt(np.mean(np.square(sequence.densities))))
        rule = PairingRule(volume.low, volume.high, 0.0, density_rms, 0.0, least_gap=True)
        chosen = pair.choose(slice(0, rows), candidates, rule)
        omega, sigma = chosen.omega, chosen.omega_sigma
        known: Mask = np.asarray(np.isfinite(omega).all(axis=0))
        light = np.sqrt(np.nansum([f.amplitude**2 for f in found], axis=1)).astype(np.float32)
        corrected = correct_texture(
            omega, sigma, light, known, known, pair.meet, maximum_shift_px=0.5, threads=threads
        )
        noise = measurement.noise(frames.mean(axis=0, dtype=np.float32))
        weak = (chosen.amplitude < ReconstructParameters().minimum_modulation_to_noise * noise).any(axis=0)
        points = pair.meet(omega, sigma)
        bad = outside_box(points.xyz, volume.low, volume.high) | np.isnan(points.xyz[0]) | weak
        bad |= corrected.beside
        points.xyz[:, bad] = np.nan
        reason = np.where(bad, np.uint32(Reason.OUT_OF_VOLUME), np.uint32(Reason.VALID))
        return Surface("C1P1", "mm", points.xyz, reason, points.covariance, points.ray_gap)

    def off_plane(self, cloud: Surface) -> Floats:
        """Return how far every point lies off the plane through those that are lit once, in mm.

        (rows, columns), NaN beside the plate and where nothing valid was measured.
        """
        flat = cloud.position[:, self.once & (cloud.reason == Reason.VALID)]
        off = np.tensordot(_normal(flat), cloud.position - flat.mean(axis=1)[:, None, None], axes=1)
        return np.where(self.once | self.twice, off, np.nan)

    def off_plane_sigma(self, cloud: Surface) -> Floats:
        """Return the standard deviation that the points' covariance states for `off_plane`."""
        x, y, z = _normal(cloud.position[:, self.once & (cloud.reason == Reason.VALID)])
        weights = [x * x, 2.0 * x * y, 2.0 * x * z, y * y, 2.0 * y * z, z * z]
        variance = np.tensordot(weights, position_covariance(cloud), axes=1)
        return np.where(self.once | self.twice, np.sqrt(np.maximum(variance, 0.0)), np.nan)


def _normal(points: Floats) -> Floats:
    """Return the normal of the plane through points (3, n)."""
    _, vectors = np.linalg.eigh(np.cov(points))
    return np.asarray(vectors[:, 0])


def record(size: Size, fringes: int, threads: int) -> Plate:
    """Render the plate and mirror with the sequence 0 .. fringes - 1, frames in memory."""
    calibration, campaign = plate_and_mirror("plate-and-mirror", size, fringes)
    assert campaign.scene is not None
    simulation = Simulation(campaign.scene, "C1", "P1", ())
    shape = exact_shape(simulation, threads=threads)
    light = trace(simulation, threads)
    _, rows, columns = light.x.shape
    blocks = light.strength.reshape(2, rows // SUBSAMPLES, SUBSAMPLES, columns // SUBSAMPLES, SUBSAMPLES)
    lit = blocks > 0.0
    every: Mask = np.asarray(lit.all(axis=(2, 4)))
    any_of: Mask = np.asarray(lit.any(axis=(2, 4)))
    plate = shape.seen & shape.lit & (shape.region == 1)
    inside = np.ones((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.bool_)
    twice = ndimage.binary_erosion(plate & every[0] & every[1], inside)
    once = ndimage.binary_erosion(plate & every[0] & ~any_of[1], inside)
    rendering = render(simulation, campaign.sequence, threads=threads)
    frames = ArrayStack(rendering.frames.rows(0, rows // SUBSAMPLES))
    measurement = Measurement(
        START,
        campaign.sequence,
        rendering.full_scale,
        rendering.gain,
        rendering.read_noise,
        rendering.texture,
        frames,
        simulation,
    )
    return Plate(calibration, measurement, once, twice, np.abs(shape.material[0]))


def only(plate: Plate, densities: tuple[float, ...]) -> Plate:
    """Return a plate of which only some of the densities were recorded, in another order perhaps."""
    old = list(plate.measurement.sequence.patterns())
    new = replace(plate.measurement.sequence, densities=densities)
    chosen = [old.index(pattern) for pattern in new.patterns()]
    stack = plate.measurement.frames.rows(0, plate.measurement.frames.shape[1])
    measurement = replace(plate.measurement, sequence=new, frames=ArrayStack(stack[chosen]))
    return replace(plate, measurement=measurement)


def rms_off(off: Floats, where: Mask) -> tuple[float, float]:
    """Return the rms of what a map knows of some pixels, in its unit, and which part of them it knows."""
    known = off[where & np.isfinite(off)]
    return float(np.sqrt(np.mean(np.square(known)))) if known.size else float("nan"), known.size / where.sum()


UNMASKED = {
    "maximum_phase_error_rad": 10.0,
    "calibration_sigma_px": 300.0,
    "minimum_pair_margin": 0.0,
}
"""Every pixel that is measured inside the volume counts, however doubtful: the thesis masks none of them."""


def unwrapped(plate: Plate, threads: int, masks: dict[str, Any]) -> Surface:
    """Reconstruct the plate from its frames of 32, 31, 30, 28, 24 and 16 fringes alone."""
    return only(plate, reverse_exponential(32)).points({"method": "temporal-unwrapping", **masks}, threads)
