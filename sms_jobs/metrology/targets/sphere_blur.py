"""What the blur of a camera does to the phase on a sphere, and how it is taken back."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import Pose, project, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics


def sphere_image_in_projector(
    camera: tuple[Intrinsics, Pose],
    projector: tuple[Intrinsics, Pose],
    centre: Floats,
    radius_mm: float,
    pixels: Floats,
) -> Floats:
    """Return where in the projector's image camera pixels (n, 2) see a sphere, (n, 2); NaN beside it."""
    direction = ray_directions(*camera, pixels)
    away = camera[1].centre() - centre
    along = np.sum(direction * away, axis=-1)
    with np.errstate(invalid="ignore"):
        distance = -along - np.sqrt(along**2 - away @ away + radius_mm**2)
    points = camera[1].centre() + distance[..., None] * direction
    return project(*projector, points)


def blur_shift(
    camera: tuple[Intrinsics, Pose],
    projector: tuple[Intrinsics, Pose],
    centre: Floats,
    radius_mm: float,
    pixels: Floats,
    brightness_slope: Floats,
    blur_px: float,
) -> Floats:
    """Return by how much blur moves the projector's pixel that is measured on a sphere.

    Parameters
    ----------
    camera, projector
        Intrinsics and pose of each.
    centre, radius_mm
        Of the sphere, (3,) and one number, in mm; to a hundredth of the radius is enough.
    pixels
        (n, 2) of the camera.
    brightness_slope
        (n, 2), derivative of the logarithm of the modulation by x and y, in 1/px.
    blur_px
        Standard deviation of the spot that a camera's pixel sees.

    Returns
    -------
    (n, 2) in projector px, to be subtracted from what was measured; NaN at the limb.

    Notes
    -----
    A pixel's phase is the mean over its spot, weighted by modulation. With the spot's variance s^2 and to
    second order, the mean of x(u) is x + s^2 (half the Laplacian of x + slope of x times slope of the
    logarithm of the modulation). On a sphere of 25 mm at 1 mm a pixel this is some 50 um, always away from
    the sensors, and would go straight into a calibration.
    """
    step = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    middle, right, left, below, above = sphere_image_in_projector(
        camera, projector, centre, radius_mm, pixels + step[:, None, :]
    )
    laplacian = right + left + below + above - 4.0 * middle
    slope = 0.5 * np.stack([right - left, below - above], axis=-1)
    pull = np.einsum("nij,nj->ni", slope, brightness_slope)
    return np.asarray(blur_px**2 * (0.5 * laplacian + pull))
