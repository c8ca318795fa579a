"""How a sheet of dots about a cylinder is seen, and where the centres of its dots are in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.errors import CalibrationFailed
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.geometry.projection_matrix import fit_projection, whitening
from sms_jobs.metrology.geometry.wrapped_sheets import around_in_space, in_space
from sms_jobs.metrology.targets.circles import reach_inside
from sms_jobs.metrology.targets.drawn_dots import fitted_centres, outline_points
from sms_jobs.metrology.targets.perspective import bend_size, bend_terms, ellipse_matrices

_LEAST_POINTS = 12
_DRAWN = 0.4  # 66 degrees: what is left out for good is told by dots that are drawn
_NARROWEST = 0.64  # 50 degrees: beyond, shading and curvature leave more than 0.01 px


@dataclass(frozen=True)
class WrappedView:
    """How a sheet about a cylinder is seen: a pin-hole camera and, on top of it, a bend by the lens.

    Attributes
    ----------
    matrix
        (3, 4), from space in mm to the image in px.
    radius_mm
        Of the cylinder, which lies behind the sheet.
    bend, middle, reach
        See `PlaneView`; of places on the sheet, each taken on the turn that is nearest to `middle`.
    """

    matrix: Floats
    radius_mm: float
    bend: Floats
    middle: Floats
    reach: float

    def image(self, points: Floats) -> Floats:
        """Return the images (n, 2) in px of places (n, 2) of the sheet in mm."""
        mapped = self._mapped(points)
        return np.asarray(mapped[:, :2] / mapped[:, 2:] + self._bent(points, 0, 0))

    def jacobian(self, points: Floats) -> Floats:
        """Return d(image)/d(place), (n, 2, 2) in px/mm; its determinant is negative on the far side."""
        mapped = self._mapped(points)
        tangents = self._tangents(points)
        numerator = tangents[:, :2] * mapped[:, 2, None, None] - mapped[:, :2, None] * tangents[:, 2:]
        straight = numerator / mapped[:, 2, None, None] ** 2
        bent = np.stack([self._bent(points, 1, 0), self._bent(points, 0, 1)], axis=-1)
        return np.asarray(straight + bent)

    def faces(self, points: Floats) -> Mask:
        """Return which places (n,) are seen, and not too obliquely: what is round there is not too narrow."""
        return self._wider(points, _NARROWEST)

    def centre_bias(self, points: Floats, diameters: Floats, blur_px: float) -> Floats:
        """Return the centres of the ellipses that are found of dots, minus the images of the dots' centres.

        A dot is a disc on the sheet, and its image a bent ellipse. It is drawn with its blur and fitted as
        dots of pictures are; the light on it is even.

        Parameters
        ----------
        points, diameters
            (n, 2) and (n,), of the dots, in mm.
        blur_px
            Standard deviation of the blur of lens and pixel together.

        Returns
        -------
        (n, 2), in px; NaN for dots at the rim or on the far side.
        """
        bias = np.full(points.shape, np.nan)
        seen = self._wider(points, _DRAWN)
        points, diameters = points[seen], np.asarray(diameters, np.float64)[seen]
        if not len(points):
            return bias
        matrix = ellipse_matrices(self, points, diameters)
        semi = 1.0 / np.linalg.eigvalsh(matrix)
        count = outline_points(float(semi.max()), blur_px)
        angle = 2.0 * np.pi * np.arange(count) / count
        disc = 0.5 * diameters[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        outline = self.image((points[:, None] + disc).reshape(-1, 2)).reshape(disc.shape)
        reach = reach_inside(semi.min(axis=1))
        bias[seen] = fitted_centres(outline, matrix, blur_px, reach) - self.image(points)
        return bias

    def _wider(self, points: Floats, least: float) -> Mask:
        """Return where what is round on the near side has at least some width for its length."""
        jacobian = self.jacobian(points)
        size = np.linalg.svd(jacobian, compute_uv=False)
        return np.asarray((np.linalg.det(jacobian) > 0.0) & (size[:, 1] > least * size[:, 0]))

    def _mapped(self, points: Floats) -> Floats:
        space = in_space(np.pad(points, ((0, 0), (0, 1))), self.radius_mm)
        return np.asarray(space @ self.matrix[:, :3].T + self.matrix[:, 3])

    def _tangents(self, points: Floats) -> Floats:
        """Return derivatives of homogeneous images by places, (n, 3, 2)."""
        around = around_in_space(points[:, 0], self.radius_mm)
        along = np.broadcast_to(self.matrix[:, 1], around.shape)
        return np.stack([around @ self.matrix[:, :3].T, along], axis=-1)

    def _bent(self, points: Floats, by_x: int, by_y: int) -> Floats:
        scaled = (_near(points, self.middle, self.radius_mm) - self.middle) / self.reach
        return np.asarray(
            bend_terms(scaled, len(self.bend), by_x, by_y) @ self.bend / self.reach ** (by_x + by_y)
        )


def fit_wrapped_view(points: Floats, image: Floats, radius_mm: float) -> WrappedView:
    """Fit a pin-hole camera, and the bend of the lens where there are enough points, by least squares.

    Parameters
    ----------
    points
        (n, 2), on the sheet, in mm: x around and y along the cylinder.
    image
        (n, 2), their images, in px.
    radius_mm
        Of the cylinder.

    Raises
    ------
    ValueError
        Where there are fewer than twelve points, or all are on a plane.
    """
    rows, columns = (len(np.unique(points[:, k])) for k in (1, 0))
    if len(points) < _LEAST_POINTS or min(rows, columns) < 3:
        raise ValueError(
            f"{len(points)} dots of a cylinder in {columns} columns and {rows} rows do not tell how it is "
            f"seen, {_LEAST_POINTS} in three columns and three rows do: show more of it"
        )
    space = in_space(np.pad(points, ((0, 0), (0, 1))), radius_mm)
    middle_x = radius_mm * np.arctan2(space[:, 0].mean(), radius_mm - space[:, 2].mean())
    middle = np.array([middle_x, points[:, 1].mean()])
    reach = float(np.abs(_near(points, middle, radius_mm) - middle).max())
    try:
        matrix = fit_projection(space, image, whitening(space), whitening(image), np.ones(len(points)))
    except CalibrationFailed as error:
        raise ValueError(str(error)) from error
    terms = bend_size(len(points))
    view = WrappedView(matrix, radius_mm, np.zeros((terms, 2)), middle, reach)
    if not terms:
        return view
    scaled = (_near(points, middle, radius_mm) - middle) / reach
    left = image - view.image(points)
    view.bend[:] = np.linalg.lstsq(bend_terms(scaled, terms, 0, 0), left, rcond=1e-9)[0]
    return view


def _near(points: Floats, middle: Floats, radius_mm: float) -> Floats:
    """Return places of a sheet on that of their turns about the cylinder that is nearest to one of them."""
    around = 2.0 * np.pi * radius_mm
    x = points[:, 0] - around * np.rint((points[:, 0] - middle[0]) / around)
    return np.stack([x, points[:, 1]], axis=-1)
