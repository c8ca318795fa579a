"""Sensor parameters as the thesis writes them, and their way into and out of the camera model of this house.

A sensor of the thesis has an image plane in millimetres with its origin at the middle of the chip, xi to the
right and eta down; a principal point and one focal length c in mm; radial distortion in powers of mm; three
angles; and the place of its pin-hole in the world.

Its distortion runs the other way round from OpenCV's: Eq. (1.22) takes the radius of the image point that is
measured, which is the distorted one, and gives what has to be taken off it to come to the ideal point,
while OpenCV distorts the ideal point by a polynomial in its own radius. The inverse of a polynomial is none,
so k1, k2 and k3 are carried over by least squares over the image, and the residual is stated in pixels.
Everything else is carried over exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, atan2, hypot
from typing import Literal, TypeAlias

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics, undistort
from sms_jobs.metrology.geometry.transforms import rotation_from_angles

Pitch: TypeAlias = Literal["L/N", "L/(N-1)"]

_GRID = 41  # points along each side of the image for the least squares: 1681 for three unknowns
_UPRIGHT = 1e-12  # cos(phi) below which omega and kappa turn about the same axis


@dataclass(frozen=True)
class ImagePlane:
    """The chip of a camera or projector.

    Attributes
    ----------
    length_mm
        L: width and height of the chip.
    pixels
        N: columns and rows.
    pitch
        Distance of neighbouring pixels: L / N, or L / (N - 1) as the thesis prints it, for parameters that
        were estimated with that.
    """

    length_mm: tuple[float, float]
    pixels: tuple[int, int]
    pitch: Pitch = "L/N"

    def intervals(self) -> Floats:
        """Return how many pixel pitches make the chip's width and height, (2,)."""
        return np.array(self.pixels, dtype=np.float64) - (1.0 if self.pitch == "L/(N-1)" else 0.0)


@dataclass(frozen=True)
class ThesisParameters:
    """The twelve parameters of a sensor (thesis section 2.4.1).

    Attributes
    ----------
    xi_h, eta_h
        Principal point, in mm from the middle of the chip.
    c
        Focal length, in mm.
    k1, k2, k3
        Radial distortion, in 1/mm^2, 1/mm^4 and 1/mm^6.
    omega, phi, kappa
        Angles, in rad.
    pin_hole
        X0, Y0, Z0: in the world, in mm.
    """

    xi_h: float
    eta_h: float
    c: float
    k1: float
    k2: float
    k3: float
    omega: float
    phi: float
    kappa: float
    pin_hole: tuple[float, float, float]


@dataclass(frozen=True)
class Misfit:
    """What the conversion of a distortion leaves over the image, in px: root mean square and largest."""

    rms_px: float
    largest_px: float


def plane_from_pixels(plane: ImagePlane, pixels: Floats) -> Floats:
    """Return image plane coordinates (..., 2) in mm of pixels (..., 2), the top-left centre being (0, 0).

    Thesis Eq. (1.19), corrected: xi = ((x + 1/2) / N - 1/2) L, so that pixels are L / N apart; with the
    pitch L / (N - 1), as it is printed: xi = (x / (N - 1) - 1/2) L.
    """
    length = np.array(plane.length_mm)
    offset = 0.5 if plane.pitch == "L/N" else 0.0
    return np.asarray(((np.asarray(pixels) + offset) / plane.intervals() - 0.5) * length)


def pixels_from_plane(plane: ImagePlane, points: Floats) -> Floats:
    """Return pixels (..., 2) of image plane coordinates (..., 2) in mm: inverse of thesis Eq. (1.19)."""
    length = np.array(plane.length_mm)
    offset = 0.5 if plane.pitch == "L/N" else 0.0
    return np.asarray((np.asarray(points) / length + 0.5) * plane.intervals() - offset)


def distortion_correction(parameters: ThesisParameters, points: Floats) -> Floats:
    """Return (d xi, d eta), (..., 2) in mm, at measured image points (..., 2) in mm.

    Thesis Eq. (1.22), with the radius of the measured point about the principal point.
    """
    from_principal = np.asarray(points) - [parameters.xi_h, parameters.eta_h]
    r2 = np.sum(from_principal**2, axis=-1, keepdims=True)
    k1, k2, k3 = parameters.k1, parameters.k2, parameters.k3
    return np.asarray(from_principal * (r2 * (k1 + r2 * (k2 + r2 * k3))))


def normalised_from_plane(parameters: ThesisParameters, points: Floats) -> Floats:
    """Return x / z and y / z of the ray, (..., 2), at measured image points (..., 2) in mm.

    Thesis Eq. (1.21), solved for x / z: (xi - xi_H - d xi) / c.
    """
    measured = np.asarray(points)
    principal = [parameters.xi_h, parameters.eta_h]
    return np.asarray((measured - principal - distortion_correction(parameters, measured)) / parameters.c)


def angles_from_rotation(rotation: Floats) -> tuple[float, float, float]:
    """Return (omega, phi, kappa) in rad of a (3, 3) rotation: inverse of thesis Eq. (1.24), corrected.

    Where phi is a quarter turn only one combination of omega and kappa is defined, and kappa is 0.
    """
    r = np.asarray(rotation)
    cos_phi = hypot(r[2, 1], r[2, 2])
    phi = atan2(r[2, 0], cos_phi) if cos_phi > 0.5 else asin(float(np.clip(r[2, 0], -1.0, 1.0)))
    if cos_phi < _UPRIGHT:
        return atan2(r[1, 2], r[1, 1]), phi, 0.0
    return atan2(-r[2, 1], r[2, 2]), phi, atan2(-r[1, 0], r[0, 0])


def pose_from_thesis(parameters: ThesisParameters) -> Pose:
    """Return the pose of a sensor.

    Thesis Eq. (1.23)-(1.25), the last corrected: (X0, Y0, Z0) is the pin-hole, so T = -R (X0, Y0, Z0).
    """
    rotation = rotation_from_angles(parameters.omega, parameters.phi, parameters.kappa)
    return Pose.from_arrays(rotation, -rotation @ np.array(parameters.pin_hole))


def sensor_from_thesis(parameters: ThesisParameters, plane: ImagePlane) -> tuple[Intrinsics, Pose, Misfit]:
    """Return a sensor of the thesis in this house's camera model, and what its distortion leaves over.

    Focal lengths c N / L in px, the principal point by Eq. (1.19), the pose by Eq. (1.23)-(1.25). With the
    measured point p and the ray n of Eq. (1.21), both in units of c, k1, k2 and k3 minimise
    |n (k1 r^2 + k2 r^4 + k3 r^6) - (p - n)|^2 over the image, r being the length of n.
    """
    focal = parameters.c * plane.intervals() / np.array(plane.length_mm)
    centre = pixels_from_plane(plane, np.array([parameters.xi_h, parameters.eta_h]))
    points = plane_from_pixels(plane, _grid(plane.pixels))
    measured = (points - [parameters.xi_h, parameters.eta_h]) / parameters.c
    rays = normalised_from_plane(parameters, points)
    (k1, k2, k3), misfit = _radial_fit(rays, measured - rays, focal)
    fx, fy, cx, cy = (float(value) for value in (*focal, *centre))
    intrinsics = Intrinsics(fx, fy, cx, cy, k1=k1, k2=k2, k3=k3)
    return intrinsics, pose_from_thesis(parameters), misfit


def thesis_from_sensor(
    intrinsics: Intrinsics, pose: Pose, pixels: tuple[int, int], pixel_pitch_mm: float
) -> tuple[ThesisParameters, ImagePlane, Misfit]:
    """Return a sensor as the thesis writes it, and what its distortion leaves over.

    The parameters of Eq. (1.19)-(1.25). A pixel is `pixel_pitch_mm` wide; its height follows from fx and fy,
    because the thesis has one focal length. Tangential distortion has no place in Eq. (1.22): the radial
    terms are the best that the image allows, and the misfit says what that costs.
    """
    columns, rows = pixels
    c = intrinsics.fx * pixel_pitch_mm
    plane = ImagePlane((columns * pixel_pitch_mm, rows * c / intrinsics.fy), pixels)
    xi_h, eta_h = plane_from_pixels(plane, np.array([intrinsics.cx, intrinsics.cy]))
    focal = np.array([intrinsics.fx, intrinsics.fy])
    measured = (_grid(pixels) - [intrinsics.cx, intrinsics.cy]) / focal
    rays = undistort(intrinsics, measured)
    seen = np.isfinite(rays).all(axis=-1)
    (k1, k2, k3), misfit = _radial_fit(measured[seen], measured[seen] - rays[seen], focal)
    omega, phi, kappa = angles_from_rotation(pose.matrix())
    x0, y0, z0 = (float(v) for v in pose.centre())
    parameters = ThesisParameters(
        float(xi_h), float(eta_h), c, k1 / c**2, k2 / c**4, k3 / c**6, omega, phi, kappa, (x0, y0, z0)
    )
    return parameters, plane, misfit


def _grid(pixels: tuple[int, int]) -> Floats:
    """Return pixels (n, 2) spread evenly over an image, edges included."""
    x, y = np.meshgrid(np.linspace(-0.5, pixels[0] - 0.5, _GRID), np.linspace(-0.5, pixels[1] - 0.5, _GRID))
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def _radial_fit(
    points: Floats, differences: Floats, focal: Floats
) -> tuple[tuple[float, float, float], Misfit]:
    """Fit differences (n, 2) by p (k1 r^2 + k2 r^4 + k3 r^6) at points p (n, 2), weighted by px."""
    r2 = np.sum(points**2, axis=-1, keepdims=True)
    scale = float(r2.max())
    terms = np.stack([points * (r2 / scale) ** n * focal for n in (1, 2, 3)], axis=-1)
    target = differences * focal
    found, *_ = np.linalg.lstsq(terms.reshape(-1, 3), target.ravel(), rcond=None)
    residual = np.linalg.norm(target - terms @ found, axis=-1)
    misfit = Misfit(float(np.sqrt(np.mean(residual**2))), float(residual.max()))
    k1, k2, k3 = (float(k) / scale**n for n, k in enumerate(found, start=1))
    return (k1, k2, k3), misfit
