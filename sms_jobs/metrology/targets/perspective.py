"""Where the centre of a circle is in an image: not at the centre of the ellipse that the circle becomes."""

from __future__ import annotations

from dataclasses import dataclass
from math import perm
from typing import Protocol

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask

_DEGREES = ((60, 5), (30, 3), (14, 2))  # the bend's degree, by the least number of points that it needs


class View(Protocol):
    """How a sheet of dots is seen, flat or not; points are (n, 2) on the sheet, in mm."""

    def image(self, points: Floats) -> Floats:
        """Return the images (n, 2) in px."""
        ...

    def jacobian(self, points: Floats) -> Floats:
        """Return d(image)/d(point), (n, 2, 2) in px/mm."""
        ...

    def faces(self, points: Floats) -> Mask:
        """Return which points (n,) are seen, and not too obliquely."""
        ...

    def centre_bias(self, points: Floats, diameters: Floats, blur_px: float) -> Floats:
        """Return the centres of ellipses, blurred so, minus the images of dots' centres, (n, 2) in px."""
        ...


@dataclass(frozen=True)
class PlaneView:
    """How a plane is seen: a homography and, on top of it, a bend by the lens.

    Attributes
    ----------
    homography
        (3, 3), from the plane in mm to the image in px.
    bend
        (terms, 2), coefficients in px of a polynomial of plane coordinates that are shifted by `middle` and
        divided by `reach`: 1, x, y, x^2, xy, y^2, x^3, ...; of degree 5, 3 or 2, or none.
    middle
        (2,), in mm.
    reach
        In mm.
    """

    homography: Floats
    bend: Floats
    middle: Floats
    reach: float

    def image(self, points: Floats) -> Floats:
        """Return the images (n, 2) in px of points (n, 2) of the plane in mm."""
        straight = through_homography(self.homography, points)
        scaled = (points - self.middle) / self.reach
        return np.asarray(straight + bend_terms(scaled, len(self.bend), 0, 0) @ self.bend)

    def jacobian(self, points: Floats) -> Floats:
        """Return d(image)/d(point), (n, 2, 2) in px/mm."""
        h = self.homography
        p = points @ h[:, :2].T + h[:, 2]
        numerator = h[:2, :2] * p[:, 2, None, None] - p[:, :2, None] * h[2, :2]
        straight = numerator / p[:, 2, None, None] ** 2
        if not len(self.bend):
            return np.asarray(straight)
        scaled, n = (points - self.middle) / self.reach, len(self.bend)
        bent = [bend_terms(scaled, n, *by) @ self.bend / self.reach for by in ((1, 0), (0, 1))]
        return np.asarray(straight + np.stack(bent, axis=-1))

    def faces(self, points: Floats) -> Mask:
        """Return which points (n,) are seen: all, since dots of a plane are judged by their own ellipses."""
        return np.ones(len(points), np.bool_)

    def centre_bias(self, points: Floats, diameters: Floats, blur_px: float) -> Floats:
        """Return `centre_bias_of_view`, on which blur has no bearing."""
        return centre_bias_of_view(self, points, diameters)

    def curvature(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the second derivatives xx, xy, yy of the bend, each (n, 2) in px/mm^2."""
        scaled, n = (points - self.middle) / self.reach, len(self.bend)
        xx, xy, yy = (
            np.asarray(bend_terms(scaled, n, *by) @ self.bend / self.reach**2)
            for by in ((2, 0), (1, 1), (0, 2))
        )
        return xx, xy, yy


def bend_terms(scaled: Floats, count: int, by_x: int, by_y: int) -> Floats:
    """Return derivatives (n, count) of the first monomials, `by_x` times by x and `by_y` times by y."""
    x, y = scaled.T
    columns = np.zeros((len(scaled), count))
    powers = [(degree - k, k) for degree in range(6) for k in range(degree + 1)]
    for column, (a, b) in zip(columns.T, powers, strict=False):
        if a >= by_x and b >= by_y:
            column[:] = perm(a, by_x) * x ** (a - by_x) * perm(b, by_y) * y ** (b - by_y)
    return columns


def bend_size(points: int) -> int:
    """Return how many terms of a bend so many points tell: of degree 5 from 60 on, 3 from 30, 2 from 14."""
    degree = next((degree for least, degree in _DEGREES if points >= least), -1)
    return (degree + 1) * (degree + 2) // 2


def through_homography(homography: Floats, points: Floats) -> Floats:
    """Return the images (n, 2) of points (n, 2)."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def fit_plane_view(points: Floats, image: Floats) -> PlaneView:
    """Fit a homography, and the bend of the lens where there are enough points, by least squares.

    Parameters
    ----------
    points
        (n, 2), on the plane, in mm; n >= 4, not on a line.
    image
        (n, 2), their images, in px.

    Returns
    -------
    The view; its bend is quadratic from 14 points on, cubic from 30, quintic from 60, else absent.

    Raises
    ------
    ValueError
        Where there are fewer than four points, or all are on a line.
    """
    import cv2

    if len(points) < 4:
        raise ValueError("a plane's view needs four points that are not on a line")
    found, _ = cv2.findHomography(points.astype(np.float64), image.astype(np.float64), 0)
    middle = np.asarray(points.mean(axis=0), dtype=np.float64)
    reach = float(np.abs(points - middle).max())
    spread = np.linalg.matrix_rank(points - middle, tol=1e-6 * reach)
    if found is None or spread < 2:
        raise ValueError("a plane's view needs four points that are not on a line")
    homography = np.asarray(found, dtype=np.float64)
    terms = bend_size(len(points))
    bend = np.zeros((terms, 2))
    if terms:
        left = image - through_homography(homography, points)
        bend[:] = np.linalg.lstsq(bend_terms((points - middle) / reach, terms, 0, 0), left, rcond=1e-9)[0]
    return PlaneView(homography, bend, middle, reach)


def dual_conics(homography: Floats, centres: Floats, radius: Floats) -> Floats:
    """Return the dual conics (n, 3, 3) in the image of circles on a plane.

    The dual conic of a circle of radius r about X = (x, y, 1) is r^2 diag(1, 1, 0) - X X^T, and a
    homography H maps a dual conic C to H C H^T (Hartley and Zisserman 2004, Result 2.14).

    Parameters
    ----------
    homography
        (3, 3), from the plane in mm to the image in px.
    centres
        (n, 2), in mm.
    radius
        (n,), in mm.
    """
    points = centres @ homography[:, :2].T + homography[:, 2]
    flat = homography[:, :2] @ homography[:, :2].T
    return np.asarray(radius[:, None, None] ** 2 * flat - points[:, :, None] * points[:, None, :])


def centre_bias(homography: Floats, centres: Floats, diameters: Floats) -> Floats:
    """Return the centres of the ellipses minus the images of the circles' centres, exactly.

    The centre of an ellipse is the pole of the line at infinity: the last column of its dual conic, as a
    homogeneous point (Heikkila 2000; Hartley and Zisserman 2004, Section 2.2.3).

    Parameters
    ----------
    homography
        (3, 3), from the plane in mm to the image in px.
    centres
        (n, 2), of the circles, in mm.
    diameters
        (n,), in mm.

    Returns
    -------
    (n, 2), in px; to be subtracted from the measured centres of the ellipses. Lens distortion is left out:
    see `centre_bias_of_view`.
    """
    pole = dual_conics(homography, centres, 0.5 * np.asarray(diameters, np.float64))[:, :, 2]
    return np.asarray(pole[:, :2] / pole[:, 2:] - through_homography(homography, centres))


def centre_bias_of_view(view: PlaneView, centres: Floats, diameters: Floats) -> Floats:
    """Return `centre_bias` with the share of lens distortion added to second order.

    A bend w = A^-1 f of the view f with Jacobian A moves the edge of a circle of radius r by
    (r^2 / 2) w''(n, n) in the direction n. The first harmonic of its normal component is a shift of the
    fitted ellipse by (r^2 / 8) (3 w^x_xx + w^x_yy + 2 w^y_xy) along x, and likewise along y. Third
    derivatives change only axes, fourth derivatives (of the order r^4) are neglected, and so is that an
    oblique ellipse weights its edge otherwise than a circle.

    Parameters
    ----------
    view
        Of the plane.
    centres, diameters
        (n, 2) and (n,), in mm.

    Returns
    -------
    (n, 2), in px.
    """
    straight = centre_bias(view.homography, centres, diameters)
    if not len(view.bend):
        return straight
    jacobian = view.jacobian(centres)
    xx, xy, yy = (np.linalg.solve(jacobian, d[:, :, None])[:, :, 0] for d in view.curvature(centres))
    shift = np.stack(
        [
            3.0 * xx[:, 0] + yy[:, 0] + 2.0 * xy[:, 1],
            3.0 * yy[:, 1] + xx[:, 1] + 2.0 * xy[:, 0],
        ],
        axis=-1,
    )
    shift *= (0.5 * np.asarray(diameters, np.float64))[:, None] ** 2 / 8.0
    return np.asarray(straight + (jacobian @ shift[:, :, None])[:, :, 0])


def ellipse_matrices(view: View, centres: Floats, diameters: Floats) -> Floats:
    """Return M (n, 2, 2) in 1/px of the ellipses |M (x - c)| = 1 that circles become, to first order."""
    jacobian = view.jacobian(centres) * (0.5 * np.asarray(diameters, np.float64))[:, None, None]
    values, vectors = np.linalg.eigh(jacobian @ np.swapaxes(jacobian, 1, 2))
    return np.asarray((vectors / np.sqrt(values)[:, None, :]) @ np.swapaxes(vectors, 1, 2))
