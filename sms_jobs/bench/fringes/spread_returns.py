"""A plate that other light reaches too, sharp or spread over the projector's image, signal by signal.

The scanner of thesis section 7.3.1 looks at a plane; every pixel has its direct light, one point of the
projector, and light that came by way of something else, with a known density over the projector's image. The
signals are exact sums over that density, and the frames have nothing but noise besides: no lens blurs them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi, radians, sqrt

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.fringes.returns import FULL_SCALE, MODULATION, STEPS, patterns
from sms_jobs.kinds.shape.phase_task import Geometry, Known, PhaseParameters, PhaseTask, mark
from sms_jobs.kinds.shape.phases import sensor_pair
from sms_jobs.kinds.shape.ranged_phases import amplitude_spread, range_slab, rows_that_tell, shares_amplitudes
from sms_jobs.metrology.arrays import Floats, Mask, Reasons
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.images.masks import large_ray_gap, outside_box
from sms_jobs.metrology.phase.fourier_domain_ranging import range_returns
from sms_jobs.metrology.phase.patterns import direction, span_px
from sms_jobs.metrology.phase.sequences import ranging
from sms_jobs.records.fields import PhaseMaps, ReturnMaps
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import START, cube, plate_and_mirror

FRINGES = 64
CROSSED, DIAGONAL = (0.0, pi / 2.0), (pi / 4.0, -pi / 4.0)
SUBJECT = Subject("plate", "S00", "C1P1")
_GAP_SIGMA_PX = 0.05  # of a calibration that says nothing of itself


@dataclass(frozen=True)
class Light:
    """Light of every pixel that reached it in one way.

    Attributes
    ----------
    place
        (pixels, points, 2) or (1, points, 2): where in the projector's image it comes from, in px.
    strength
        (pixels, points), in units of the direct light of a facing plate.
    spread_px
        Standard deviation of a Gaussian cloud about each place, in px of the projector.
    """

    place: Floats
    strength: Floats
    spread_px: float = 0.0

    def signal(self, orientation: float, columns: int, rows: int) -> NDArray[np.complex128]:
        """Return z(t) of the densities 0 .. s-1, (pixels, s), of a projector of so many columns and rows."""
        middle = np.array([(columns - 1) / 2.0, (rows - 1) / 2.0])
        unit = 2.0 * pi / span_px(columns, rows, orientation)
        omega = unit * ((self.place - middle) @ np.array(direction(orientation)))
        t = np.arange(FRINGES)
        blurred = np.exp(-0.5 * (unit * self.spread_px * t) ** 2)
        if len(omega) == 1:
            return np.asarray((self.strength @ np.exp(1j * omega[0][:, None] * t)) * blurred)
        waves = np.exp(1j * omega[..., None] * t)
        return np.asarray(np.einsum("pq,pqt->pt", self.strength, waves) * blurred)


@dataclass(frozen=True)
class Plate:
    """The plate that is measured, and what is true of it.

    Attributes
    ----------
    geometry
        Of camera and projector.
    xyz
        (rows, columns, 3), the points of the plate behind the camera's pixels, in mm.
    """

    geometry: Geometry
    xyz: Floats

    @classmethod
    def seen(cls, pixels: int, orientations: tuple[float, ...]) -> Plate:
        """Return the upright plate z = 0, as a camera of so many rows and columns sees it."""
        calibration, _ = plate_and_mirror("plate", "small", FRINGES)
        camera, projector = calibration.rig.sensors
        inner, coarse = camera.intrinsics, pixels / camera.columns
        inner = replace(
            inner,
            fx=coarse * inner.fx,
            fy=coarse * inner.fy,
            cx=coarse * (inner.cx + 0.5) - 0.5,
            cy=coarse * (inner.cy + 0.5) - 0.5,
        )
        camera = replace(camera, columns=pixels, rows=pixels, intrinsics=inner)
        sequence = FringeSequence(ranging(FRINGES), orientations_rad=orientations)
        pair = sensor_pair(camera, projector, sequence, 1)
        rays, centre = pair.rays(), pair.pose.centre()
        xyz = centre - rays * (centre[2] / rays[..., 2])[..., None]
        return cls(Geometry(pair, cube(330.0), _GAP_SIGMA_PX), xyz)

    def from_projector(self, points: Floats) -> Floats:
        """Return where the projector shows points (.., 3), (.., 2) in px."""
        projector = self.geometry.pair.projector
        return project(projector.intrinsics, projector.pose, points)

    def direct(self, strength: float = 1.0, spread_px: float = 0.0) -> Light:
        """Return the light straight from the projector."""
        place = self.from_projector(self.xyz.reshape(-1, 3))[:, None]
        return Light(place, np.full(place.shape[:2], strength), spread_px)

    def mirrored(self, strength: float, spread_px: float = 0.0) -> Light:
        """Return the light by way of a mirror below the plate, 120 degrees from it, which may be brushed."""
        _, normal, hinge = _wall()
        points = self.xyz.reshape(-1, 3)
        image = points - 2.0 * ((points - hinge) @ normal)[:, None] * normal
        place = self.from_projector(image)[:, None]
        return Light(place, np.full(place.shape[:2], strength), spread_px)

    def scattered(self, albedo: float) -> Light:
        """Return the light by way of a diffuse wall in the mirror's place, 300 mm by 600 mm."""
        along, normal, hinge = _wall()
        side = 6.0
        x, far = np.meshgrid(
            np.arange(-300.0, 300.0, side) + side / 2, np.arange(0.0, 300.0, side) + side / 2
        )
        wall = hinge + x.reshape(-1, 1) * np.array([1.0, 0.0, 0.0]) + far.reshape(-1, 1) * along
        points = self.xyz.reshape(-1, 3)
        source = self.geometry.pair.projector.pose.centre()
        way = wall[None] - points[:, None]
        distance = np.linalg.norm(way, axis=2)
        leaving = np.maximum(-(way @ normal), 0.0) / distance
        arriving = np.maximum(way[..., 2], 0.0) / distance
        lit = (
            _cosine(source - wall, normal)[None]
            / _cosine(source - points, np.array([0.0, 0.0, 1.0]))[:, None]
        )
        strength = albedo * lit * leaving * arriving * side**2 / (pi * distance**2)
        return Light(self.from_projector(wall)[None], strength)

    def frames(self, lights: list[Light], signal_to_noise: float, seed: int) -> Measurement:
        """Record a plate of modulation `MODULATION` a unit of light; noise is that over `signal_to_noise`."""
        pair, noise = self.geometry.pair, MODULATION / signal_to_noise
        projector, rng = pair.projector, np.random.default_rng(seed)
        shape = self.xyz.shape[:2]
        stack = []
        for orientation in pair.orientations:
            z = sum(light.signal(orientation, projector.columns, projector.rows) for light in lights)
            mean = np.abs(np.asarray(z)[:, 0])
            for t, step in patterns(FRINGES):
                wave = np.asarray(z)[:, t] * np.exp(2j * pi * step / STEPS)
                grey = (
                    MODULATION * (1.2 * mean + wave.real)
                    + 8.0 * noise
                    + noise * rng.standard_normal(len(mean))
                )
                stack.append(np.rint(grey).reshape(shape).astype(np.uint16))
        sequence = FringeSequence(ranging(FRINGES), orientations_rad=pair.orientations)
        texture = np.zeros(shape, np.uint16)
        return Measurement(START, sequence, FULL_SCALE, 0.0, noise, texture, ArrayStack(np.array(stack)))

    def measured(self, measurement: Measurement, parameters: PhaseParameters) -> Measured:
        """Range frames, pair the returns, and triangulate: what is trusted by phase, pair, gap and volume."""
        orientations = self.geometry.pair.orientations
        rows, columns = self.xyz.shape[:2]
        task = PhaseTask(SUBJECT, measurement, parameters, 1, self.geometry)
        many = len(orientations)
        known = Known([np.ones(FRINGES)] * many, [None] * many, [], corrected=False)
        if shares_amplitudes(parameters):
            told = rows_that_tell(measurement)
            known = replace(known, amplitude_spread=amplitude_spread(task, told, known.transfers, None))
        phase = PhaseMaps.unset(orientations, rows, columns, bracketed=False)
        returns = ReturnMaps.unset(orientations, parameters.returns, rows, columns)
        reason = np.zeros((rows, columns), np.uint32)
        frames = measurement.frames.rows(0, rows)
        range_slab(task, known, slice(0, rows), frames, phase, returns, reason)
        points = self.geometry.pair.meet(phase.omega, phase.omega_sigma)
        box = self.geometry.volume
        mark(reason, outside_box(points.xyz, box.low, box.high), Reason.OUT_OF_VOLUME)
        floor = self.geometry.gap_sigma_mm(points.xyz)
        apart = large_ray_gap(
            points.ray_gap, points.ray_gap_sigma, floor, parameters.maximum_ray_gap_to_noise
        )
        mark(reason, apart, Reason.LARGE_RAY_GAP)
        off = points.xyz - np.moveaxis(self.xyz, -1, 0)
        ray = np.moveaxis(self.geometry.pair.rays(), -1, 0)
        sigma = np.sqrt(trace(points.covariance))
        return Measured(reason, np.asarray((off * ray).sum(axis=0)), sigma, returns)


@dataclass(frozen=True)
class Measured:
    """Points of a plate, all (rows, columns): why not valid, error along the ray in mm and its sigma."""

    reason: Reasons
    error: Floats
    sigma: Floats
    returns: ReturnMaps

    @property
    def valid(self) -> Mask:
        """Return which points are valid."""
        return np.asarray(self.reason == Reason.VALID)

    def wrong(self, least_mm: float = 0.1) -> Mask:
        """Return which points are valid and off by more than six deviations and `least_mm`."""
        far = np.abs(self.error) > np.maximum(6.0 * self.sigma, least_mm)
        return np.asarray(self.valid & far)

    def scatter(self) -> float:
        """Return the rms of the valid points' errors over their deviations; NaN where none is valid."""
        ratio = (self.error / self.sigma)[self.valid]
        return float(np.sqrt(np.mean(ratio**2))) if ratio.size else float("nan")


@dataclass(frozen=True)
class Choice:
    """What the widths of two returns in two orientations say beside their likelihood, all (rows, columns).

    Attributes
    ----------
    wrong, wrong_by_width
        Where the pair that is chosen by gap, amplitudes and volume is off the plate, and the one that is
        chosen by its width besides.
    width
        Of the wider return of the first pair: the variance of omega inside it over its deviation from noise.
    """

    wrong: Mask
    wrong_by_width: Mask
    width: Floats


def choice(plate: Plate, measurement: Measurement, off_mm: float = 2.0) -> Choice:
    """Choose among the four pairs of two returns, written out, with and without a term of their widths.

    The term is the chi-square of a return's width against none, 9 at the most, as that of the amplitudes. Off
    the plate is a point by more than `off_mm` along its ray; what lies beyond the volume does not count.
    """
    sequence, pair = measurement.sequence, plate.geometry.pair
    frames, t = measurement.frames.rows(0, len(plate.xyz)), np.arange(FRINGES, dtype=np.float64)
    found = [
        range_returns(
            frames[sequence.frames_of(k)], sequence.densities, STEPS, measurement.grey_levels, returns=2
        )
        for k in range(2)
    ]
    # The variance of omega inside is -2 sum (t^2 - m) fall / (B sum (t^2 - m)^2), m the mean of t^2.
    spread = np.sum(t**4) - np.sum(t**2) ** 2 / FRINGES
    unit = 2.0 * sqrt(2.0 / STEPS) * measurement.read_noise / sqrt(spread)
    score = np.stack([f.width.astype(np.float64) ** 2 * f.amplitude / unit for f in found])
    floor = plate.geometry.gap_sigma_mm(np.zeros((3, 1, 1)))[0, 0]
    box, truth = plate.geometry.volume, np.moveaxis(plate.xyz, -1, 0)
    likelihood, widths, error = [], [], []
    for which in ((0, 0), (0, 1), (1, 0), (1, 1)):
        sigma = np.stack([f.omega_sigma[i] for f, i in zip(found, which, strict=True)])
        strength = np.stack([f.amplitude[i] for f, i in zip(found, which, strict=True)]).astype(np.float64)
        points = pair.meet(np.stack([f.omega[i] for f, i in zip(found, which, strict=True)]), sigma)
        variance = floor**2 + points.ray_gap_sigma.astype(np.float64) ** 2
        tolerance = 0.15**2 + np.mean(t * t) * sigma.astype(np.float64) ** 2
        odd = np.diff(np.log(strength), axis=0)[0] ** 2 / tolerance.sum(axis=0)
        evidence = points.ray_gap.astype(np.float64) ** 2 / variance + np.log(variance) + np.minimum(odd, 9.0)
        evidence += 2e3 * outside_box(points.xyz, box.low, box.high)
        likelihood.append(np.where(np.isfinite(evidence), -0.5 * evidence, -np.inf))
        widths.append(np.stack([one[i] for one, i in zip(score, which, strict=True)]))
        error.append(np.linalg.norm(points.xyz - truth, axis=0))
    by_width = [
        one - 0.5 * np.minimum(np.nansum(w**2, axis=0), 9.0)
        for one, w in zip(likelihood, widths, strict=True)
    ]
    inside = np.abs(truth).max(axis=0) < 0.97 * box.high[0]

    def of_best(values: list[Floats], weights: list[Floats]) -> Floats:
        best = np.argmax(weights, axis=0)[None]
        return np.asarray(np.take_along_axis(np.array(values), best, axis=0)[0])

    off, off_by_width = (np.asarray(inside & (of_best(error, w) > off_mm)) for w in (likelihood, by_width))
    return Choice(off, off_by_width, of_best([w.max(axis=0) for w in widths], likelihood))


def _wall() -> tuple[Floats, Floats, Floats]:
    """Return the direction of the wall away from the hinge, its normal, and a point of the hinge."""
    opening = radians(120.0)
    along = np.array([0.0, np.cos(opening), np.sin(opening)])
    normal = np.array([0.0, np.sin(opening), -np.cos(opening)])
    return along, normal, np.array([0.0, -250.0, 0.0])


def _cosine(towards: Floats, normal: Floats) -> Floats:
    return np.asarray(np.maximum(towards @ normal, 0.0) / np.linalg.norm(towards, axis=-1))
