"""Finds a specimen's frame: by points of the world, by pixels of the reference surface, by a fitted plane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.app.specimens.frame_choice import Choice, Place
from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.calibration.point_factor import KnownView, point_factor, sigma_of
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.specimen_frame import (
    AVERAGED_PX,
    PICKED_WITHIN_PX,
    FittedPlane,
    LocalPlace,
    fit_plane,
    frame_jacobian,
    frame_on_plane,
    frame_through,
    local_place,
    plane_factor,
    tiles_of,
)
from sms_jobs.metrology.geometry.transforms import unpack
from sms_jobs.metrology.images.region_of_interest import inside_outlines, parse_outlines
from sms_jobs.metrology.targets.marks import mark_at
from sms_jobs.records.fields import Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.records.specimen_frame import FrameDeviation, FramePoint, SpecimenFrame, Vector

_MOST_OF_A_PLANE = 2000  # pixels of a fitted plane that tell what the calibration adds


def through_world_points(choice: Choice) -> SpecimenFrame:
    """Return the frame through three points of the world."""
    given = [one for one in (choice.origin, choice.x, choice.plane) if one is not None]
    placement = frame_through(*(np.array(one) for one in given))
    return SpecimenFrame("points", placement, tuple(FramePoint(_three(np.array(one))) for one in given))


@dataclass(frozen=True)
class Finder:
    """A reference surface, and how a frame is to be found on it."""

    surface: Surface
    known: KnownView | None
    image: NDArray[np.generic] | None
    choice: Choice

    def frame(self, content_hash: str) -> SpecimenFrame:
        """Return the frame with its deviations."""
        picked = [self._place(one) for one in (self.choice.origin, self.choice.x, self.choice.plane) if one]
        plane = self._plane() if self.choice.region else None
        places = [place.place for place, _ in picked]
        if plane is None:
            # On a line of the image the bend of the surface would say where its plane is.
            frame_through(*(np.array([*pixel, 0.0]) for _, pixel in picked))
        middle = self._middle() if plane is not None and self.choice.origin is None else None
        if middle is not None:
            places.insert(0, middle[0])
        make, values = _construction(places, picked[0][0].outward(), plane)
        length = float(np.linalg.norm(places[1] - places[0]))
        placement = make(values)
        by_values = frame_jacobian(make, values, length)
        covariance = np.zeros((len(values), len(values)))
        first = len(places) - len(picked)
        for number, (place, _) in enumerate(picked, start=first):
            covariance[3 * number : 3 * number + 3, 3 * number : 3 * number + 3] = place.covariance
        if plane is not None:
            covariance[-3:, -3:] = plane.covariance
        if middle is not None:
            covariance[:3, :3] = middle[1]
        return SpecimenFrame(
            "points" if plane is None else "plane",
            placement,
            tuple(
                [FramePoint(_three(one)) for one in places[:first]]
                + [FramePoint(_three(place.place), pixel) for place, pixel in picked]
            ),
            self.surface.view,
            content_hash,
            self.choice.region,
            self.choice.markers,
            None if plane is None else plane.rms,
            _deviation(np.sqrt(np.diag(by_values @ covariance @ by_values.T))),
            self._from_calibration(by_values, places, plane),
        )

    @property
    def _valid(self) -> Mask:
        return np.asarray(self.surface.reason == Reason.VALID)

    def _place(self, picked: Place) -> tuple[LocalPlace, tuple[float, float]]:
        """Return where a picked pixel lies, and the pixel: of a mark its middle."""
        pixel, radius = (picked[0], picked[1]), AVERAGED_PX
        in_image = PICKED_WITHIN_PX**2 * np.eye(2)
        if self.image is not None:
            mark = mark_at(self.image, pixel)
            # Ink may have no shape: its surroundings do.
            pixel, in_image, radius = mark.centre, mark.covariance, max(radius, 2.0 * mark.radius_px)
        place = local_place(
            self.surface.position,
            position_covariance(self.surface),
            self._valid,
            pixel,
            radius_px=radius,
            together=self.surface.subset_radius_px > 0,
        )
        return place.pointed_at(in_image), pixel

    def _region(self) -> tuple[Ints, Ints]:
        """Return rows and columns of the region's pixels that have a position."""
        try:
            outlines = parse_outlines(self.choice.region)
        except ValueError as error:
            raise InvalidInput(
                f"the region cannot be read, {error}; write 'rectangle LEFT TOP RIGHT BOTTOM' or "
                "'polygon X Y X Y X Y', in px"
            ) from error
        shape = self._valid.shape
        rows, columns = np.nonzero(self._valid & inside_outlines(outlines, (shape[0], shape[1])))
        return rows, columns

    def _plane(self) -> FittedPlane:
        """Return the plane of the region, turned to the camera."""
        rows, columns = self._region()
        outward = self._place(self.choice.x)[0].outward()
        tiles = tiles_of(rows, columns) if len(rows) else np.zeros(0, np.int64)
        return fit_plane(np.ascontiguousarray(self.surface.position[:, rows, columns].T), tiles, outward)

    def _middle(self) -> tuple[Floats, Floats]:
        """Return the mean of the region's points, (3,), and its covariance from their noise, (3, 3).

        Of all points, those off the plane, too: which are left out is chance, and would move it by far more.
        """
        rows, columns = self._region()
        noise = unpack(np.asarray(position_covariance(self.surface)[:, rows, columns], dtype=np.float64))
        # Points that share a subset share its errors, which no mean of them makes less.
        alike = (2 * self.surface.subset_radius_px + 1) ** 2
        covariance = noise.mean(axis=0) * min(alike / len(rows), 1.0)
        return self.surface.position[:, rows, columns].mean(axis=1), covariance

    def _from_calibration(
        self, by_values: Floats, places: list[Floats], plane: FittedPlane | None
    ) -> FrameDeviation | None:
        """Return what the calibration adds to the deviations of a frame; None where that is not known."""
        if self.known is None:
            return None
        factors = list(point_factor(self.known, np.array(places)))
        if plane is not None:
            rows, columns = (one[plane.used] for one in self._region())
            some = slice(None, None, -(-len(rows) // _MOST_OF_A_PLANE))
            points = self.surface.position[:, rows[some], columns[some]].T
            factors.append(plane_factor(plane, points, point_factor(self.known, points)))
        sigma = sigma_of(by_values @ np.concatenate(factors))
        return _deviation(sigma) if np.isfinite(sigma).all() else None


def _construction(
    places: list[Floats], outward: Floats, plane: FittedPlane | None
) -> tuple[Callable[[Floats], Pose], Floats]:
    """Return what makes a frame of numbers, and these: coordinates, then tilts and height of a plane."""
    if plane is None:

        def through(values: Floats) -> Pose:
            return frame_through(values[:3], values[3:6], values[6:], outward)

        return through, np.concatenate(places)

    def on_plane(values: Floats) -> Pose:
        tilt = plane.normal + plane.across @ values[6:8]
        middle = plane.middle + values[8] * plane.normal
        return frame_on_plane(values[:3], values[3:6], middle, tilt)

    return on_plane, np.concatenate([*places, np.zeros(3)])


def _deviation(sigma: Floats) -> FrameDeviation:
    return FrameDeviation(_three(sigma[:3]), _three(sigma[3:]))


def _three(values: Floats) -> Vector:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
