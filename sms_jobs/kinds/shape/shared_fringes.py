"""Points where two cameras see the same fringes: phases of the one looked up in the other, and rays met."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sms_jobs.kinds.shape.phases import Phases
from sms_jobs.metrology.arrays import Floats, Mask, Reasons
from sms_jobs.metrology.geometry.partner_camera import meet_places
from sms_jobs.metrology.geometry.sensor_pair import SensorPair
from sms_jobs.metrology.geometry.transforms import PACKED
from sms_jobs.metrology.geometry.triangulation import Triangulation
from sms_jobs.metrology.phase.phase_places import PhaseMap, Places, carried
from sms_jobs.metrology.phase.seen_texture import SeenTexture, Shift
from sms_jobs.metrology.phase.texture_error import BLUR_ROWS, Corrected, textured_interior
from sms_jobs.metrology.phase.texture_of_two import (
    UNKNOWN_ROUGH_PX,
    Spots,
    estimate_rough,
    estimate_spot,
)
from sms_jobs.records.fields import PhaseMaps
from sms_jobs.records.reasons import Reason

_MOST_ROUGH = 2.0
"""Deviations of what pixels hide of texture, by which phases may be off a parabola: it is not normal."""
_BLOCK = 1 << 16
_ROUNDS = 2
"""After which slopes of phases are free of what the texture does to them."""


@dataclass(frozen=True)
class SeenFringes:
    """What a camera sees of the fringes.

    Attributes
    ----------
    maps, reason
        Of its frames.
    texture
        What it sees of the texture, where its phases can be used.
    """

    maps: PhaseMaps
    reason: Reasons
    texture: SeenTexture

    @classmethod
    def of(cls, phases: Phases, threads: int) -> SeenFringes:
        """Return what is seen by the phases that were found."""
        lit = phases.reason & Reason.LOW_MODULATION == 0
        usable = phases.reason == Reason.VALID
        return cls(phases.maps, phases.reason, SeenTexture.of(phases.maps.modulation, usable, lit, threads))

    def corrected(self, variance: float, shift: Shift) -> Floats:
        """Return the phases without the error of the texture, (directions, rows, columns) in rad."""
        return self.maps.omega - variance * shift[0]


@dataclass(frozen=True)
class MetFringes:
    """Points of a reference camera, and what they were found by.

    Attributes
    ----------
    points
        NaN where the other camera does not see what the pixel sees.
    corrected
        How the texture was corrected.
    place
        (2, n), where the other camera sees each of the pixels that could be looked up, in px.
    gap_px
        (n,), how far beside the images of their rays these lie.
    """

    points: Triangulation
    corrected: Corrected
    place: Floats
    gap_px: Floats


@dataclass(frozen=True)
class _Matched:
    """The n usable pixels of the reference camera, matched.

    See `Places` and `MetPlaces`; `depth_by_omega` in mm/rad and `gap_by_omega` in px/rad, (directions, n),
    are how distances along the rays and gaps move with phases.
    """

    place: Floats
    xyz: Floats
    gap: Floats
    pixel_mm: Floats
    depth_by_omega: Floats
    gap_by_omega: Floats


@dataclass(frozen=True)
class SharedFringes:
    """A reference camera and another one in a projector's place, and what both see of the fringes."""

    sensors: SensorPair
    own: SeenFringes
    other: SeenFringes

    @property
    def usable(self) -> Mask:
        """The pixels (rows, columns) of the reference camera that can be looked up."""
        return self.own.texture.usable

    def points(self, blur_px: float | None, most_px: float) -> MetFringes:
        """Return the point of each pixel, corrected for the texture.

        Parameters
        ----------
        blur_px
            Standard deviation of the spots of both cameras, 0 for no correction; found if None.
        most_px
            How far off a pixel's middle its light may come from.

        Notes
        -----
        Phases of both cameras have noise of their own, and that of the other counts as that of single pixels:
        the parabola's mean over nine is better, but shared by neighbours, so that a mean over many points has
        the noise of single pixels all the same.
        """
        spots, shifts = self._spots(blur_px, most_px)
        matched = self._match(spots, shifts, most_px)
        (own, rough), (other, other_rough) = self._at_points(matched.place, shifts)
        left = spots.left((own, other), (rough, other_rough))
        noise = carried(self.other.maps.omega_sigma, matched.place)
        sigma = np.sqrt(np.square(self.own.maps.omega_sigma[:, self.usable]) + noise**2 + np.square(left))
        with np.errstate(invalid="ignore"):
            part = np.square(left / sigma)
        far, doubtful = self.own.texture.beside(spots.largest(0), most_px)
        corrected = Corrected(spots.mean, far, doubtful, self._image(part).astype(np.float32))
        return MetFringes(self._spread(matched, sigma, part), corrected, matched.place, matched.gap)

    def gaps_exchanged_px(self, place: Floats) -> Floats:
        """Return the gaps (n,) of places if each camera had the calibration of the other."""
        own, other = self.sensors, self.sensors.projector
        turned = replace(own, intrinsics=other.intrinsics, pose=other.pose)
        rays = turned.rays()[self.usable]
        return meet_places(other.pose.centre(), rays, (own.intrinsics, own.pose), place).gap

    def _spots(self, blur_px: float | None, most_px: float) -> tuple[Spots, tuple[Shift, Shift]]:
        """Return the spots of both cameras, and what the texture does to their phases."""
        own, other = (_spot(seen, blur_px) for seen in (self.own, self.other))
        spots = Spots(np.array([own[0], other[0]]), np.array([own[1], other[1]]))
        shifts = (own[2], other[2])
        if blur_px == 0.0:
            return replace(spots, rough_px=0.0), shifts
        matched, telling = self._match(spots, shifts, most_px), self._telling()
        slope, rough = self._gap_slopes(matched, shifts)
        noise = self._gap_noise(matched)
        found = estimate_rough(matched.gap[telling], noise[telling], slope[telling], rough[telling])
        return replace(spots, rough_px=found), shifts

    def _telling(self) -> Mask:
        """Return which of the usable pixels (n,) tell what is hidden: on texture, of some rows."""
        inside = textured_interior(self.usable, self.own.texture.gradient)
        some = np.zeros_like(inside)
        some[:: max(len(inside) // BLUR_ROWS, 1)] = True
        return np.asarray((inside & some)[self.usable])

    def _match(self, spots: Spots, shifts: tuple[Shift, Shift], most_px: float) -> _Matched:
        """Look up the phases of the reference camera in the other, both corrected for the texture."""
        usable, texture = self.usable, self.other.texture
        own, other = (
            one.corrected(float(v), shift)
            for one, v, shift in zip((self.own, self.other), spots.variance, shifts, strict=True)
        )
        shift, rough = shifts[1]
        most_rough = min(_MOST_ROUGH * spots.rough_px, UNKNOWN_ROUGH_PX)
        off = np.hypot(spots.sigma[1] * shift, most_rough * rough)
        off = np.hypot(self.other.maps.omega_sigma, off).astype(np.float32)
        far, _ = texture.beside(spots.largest(1), most_px)
        phases = PhaseMap(other, off, texture.usable & ~far, self.sensors.threads)
        omega, sigma = own[:, usable], self.own.maps.omega_sigma[:, usable]
        rays, count = self.sensors.rays()[usable], omega.shape[1]
        blocks = (slice(start, start + _BLOCK) for start in range(0, max(count, 1), _BLOCK))
        matched = [self._met(phases.find(omega[:, b], sigma[:, b]), rays[b]) for b in blocks]
        return _Matched(*(np.concatenate(each, axis=-1) for each in zip(*matched, strict=True)))

    def _met(self, found: Places, rays: Floats) -> tuple[Floats, ...]:
        """Return what `_Matched` has of some places."""
        partner = (self.sensors.projector.intrinsics, self.sensors.projector.pose)
        met = meet_places(self.sensors.pose.centre(), rays, partner, found.place)
        depth, gap = (
            np.einsum("in,ikn->kn", by, found.by_omega) for by in (met.depth_by_place, met.gap_by_place)
        )
        return found.place, met.xyz, met.gap, met.pixel_mm, depth, gap

    def _at_points(self, place: Floats, shifts: tuple[Shift, Shift]) -> tuple[Shift, Shift]:
        """Return what the texture does to the phases of both cameras at the points, (directions, n) each."""
        own, other = shifts
        return (
            (own[0][:, self.usable], own[1][:, self.usable]),
            (carried(other[0], place), carried(other[1], place).astype(np.float32)),
        )

    def _gap_slopes(self, matched: _Matched, shifts: tuple[Shift, Shift]) -> tuple[Floats, Floats]:
        """Return how gaps (n,) change with s^2 of the reference camera, in 1/px, and with what is hidden."""
        (own, rough), (_, other_rough) = self._at_points(matched.place, shifts)
        by_gap = matched.gap_by_omega
        slope = np.sum(by_gap * own, axis=0)
        return slope, np.sqrt(np.sum(np.square(by_gap * np.hypot(rough, other_rough)), axis=0))

    def _gap_noise(self, matched: _Matched) -> Floats:
        """Return the standard deviation of gaps by the noise of both cameras' phases, (n,) in px."""
        noise = carried(self.other.maps.omega_sigma, matched.place)
        noise = np.hypot(noise, self.own.maps.omega_sigma[:, self.usable])
        return np.asarray(np.sqrt(np.sum(np.square(matched.gap_by_omega * noise), axis=0)))

    def _spread(self, matched: _Matched, sigma: Floats, part: Floats) -> Triangulation:
        """Return the points as an image, with their covariance by the standard deviations of phases."""
        rays = self.sensors.rays()[self.usable]
        moves = np.square(matched.depth_by_omega * sigma)
        variance = moves.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            told = (moves * part).sum(axis=0) / variance
        covariance = np.stack([rays[:, i] * rays[:, j] * variance for i, j in PACKED])
        gap_sigma = matched.pixel_mm * np.sqrt(np.square(matched.gap_by_omega * sigma).sum(axis=0))

        shares = self._image(told)
        shares[[0, -1]] = shares[:, [0, -1]] = 0.0  # the other side of a blob at the border is not seen
        return Triangulation(
            self._image(matched.xyz),
            self._image(covariance).astype(np.float32),
            self._image(matched.pixel_mm * matched.gap).astype(np.float32),
            self._image(gap_sigma).astype(np.float32),
            shares.astype(np.float32),
        )

    def _image(self, values: Floats) -> Floats:
        """Return values (..., n) of the usable pixels as an image (..., rows, columns), NaN elsewhere."""
        spread = np.full((*values.shape[:-1], *self.usable.shape), np.nan)
        spread[..., self.usable] = values
        return spread


def _spot(seen: SeenFringes, blur_px: float | None) -> tuple[float, float, Shift]:
    """Return s^2 of a camera and its standard deviation, and what the texture does to its phases."""
    if blur_px is None:
        return estimate_spot(seen.maps.omega, seen.maps.omega_sigma, seen.texture)
    shift = seen.texture.shift(seen.maps.omega)
    for _ in range(_ROUNDS if blur_px else 0):
        shift = seen.texture.shift(seen.corrected(blur_px**2, shift))
    return blur_px**2, 0.0, shift
