"""Carries the points of a target from a camera's image into the projector's, through the measured phase."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats

_REACH_OVER_RADIUS = 2.0  # the ink of a dot and as much of the ground as there is
_LEAST_REACH_PX = 8.0
_LEAST_PIXELS = 30
_LEAST_PART_OF_A_QUADRANT = 0.1
_ROUNDS = 5
_BISQUARE = 4.685  # Tukey's, 95 per cent efficient for normal noise


@dataclass(frozen=True)
class ProjectorPoints:
    """Points of a target in the projector's image.

    Attributes
    ----------
    pixel
        (n, 2), in projector px; NaN where there is no answer.
    sigma
        (n,), standard deviation in px in each direction, root mean square of both.
    refused
        How many points have no answer, by reason.
    """

    pixel: Floats
    sigma: Floats
    refused: dict[str, int]


def carry_to_projector(
    pixel: Floats,
    sigma: NDArray[np.floating],
    centre_px: Floats,
    centre_sigma_px: Floats,
    radius_px: Floats,
) -> ProjectorPoints:
    """Carry points from the camera's image to the projector's by local fits of second order.

    About each point the projector's x and y are polynomials of second order in the camera's x and y, fitted
    with weights 1 / sigma^2 and Tukey's bisquare to all valid pixels within twice the dot's radius (at least
    8 px), in the ink and around it. What a plane's perspective adds in third order does not move the middle.

    Parameters
    ----------
    pixel
        (2, rows, columns), x and y in projector px at each pixel of the camera; NaN where not measured.
    sigma
        (rows, columns), their standard deviations in px, in each direction.
    centre_px, centre_sigma_px
        (n, 2) and (n,), points in the camera's image and their standard deviations in each direction.
    radius_px
        (n,), radius of the dot in the camera's image; 0 for a corner.

    Returns
    -------
    The points. The standard deviation is that of the fit, raised where residuals are larger than sigma says,
    and of the point in the camera carried along; pixels are taken to be independent.
    """
    reach = np.maximum(_REACH_OVER_RADIUS * np.asarray(radius_px, np.float64), _LEAST_REACH_PX)
    found = np.full((len(centre_px), 2), np.nan)
    spread = np.full(len(centre_px), np.nan)
    refused: dict[str, int] = {}
    for i, centre in enumerate(centre_px):
        answer = _carried(pixel, sigma, centre, float(reach[i]))
        if isinstance(answer, str):
            refused[answer] = refused.get(answer, 0) + 1
            continue
        found[i], variance, jacobian = answer
        carried = 0.5 * float(np.sum(jacobian**2)) * float(centre_sigma_px[i]) ** 2
        spread[i] = np.sqrt(variance + carried)
    return ProjectorPoints(found, spread, refused)


def _carried(
    pixel: Floats, sigma: NDArray[np.floating], centre: Floats, reach: float
) -> tuple[Floats, float, Floats] | str:
    """Return a point (2,), its variance and the Jacobian (2, 2) of the map there, or why there is none."""
    rows, columns = sigma.shape
    x0, y0 = (max(0, int(np.ceil(c - reach))) for c in centre)
    x1, y1 = min(columns - 1, int(centre[0] + reach)), min(rows - 1, int(centre[1] + reach))
    if x1 < x0 or y1 < y0:
        return "outside the image"
    window = np.s_[y0 : y1 + 1, x0 : x1 + 1]
    y, x = np.mgrid[y0 : y1 + 1, x0 : x1 + 1].astype(np.float64)
    u, v = (x - centre[0]) / reach, (y - centre[1]) / reach
    near = sigma[window]
    valid = np.isfinite(pixel[:, *window]).all(axis=0) & (near > 0.0) & (u * u + v * v <= 1.0)
    u, v, spread = u[valid], v[valid], near[valid].astype(np.float64)
    quadrant = np.bincount(2 * (u > 0.0) + (v > 0.0), minlength=4)
    if len(u) < _LEAST_PIXELS:
        return "too few pixels with a phase"
    # With a whole side missing the fit would be an extrapolation.
    if quadrant.min() < _LEAST_PART_OF_A_QUADRANT * 0.25 * np.pi * reach * reach:
        return "phase on one side only"
    target = pixel[:, *window][:, valid].T
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    return _robust_fit(design, target, spread, reach)


def _robust_fit(
    design: Floats, target: Floats, spread: Floats, reach: float
) -> tuple[Floats, float, Floats] | str:
    """Fit by weighted least squares, with Tukey's weights on the residuals of both coordinates."""
    base = 1.0 / spread**2
    weight = base
    kept = np.ones_like(spread)
    scale = 1.0
    for _ in range(_ROUNDS):
        normal = design.T @ (weight[:, None] * design)
        if np.linalg.cond(normal) > 1e10:
            return "too few pixels with a phase"
        coefficients = np.linalg.solve(normal, design.T @ (weight[:, None] * target))
        residual = (target - design @ coefficients) / spread[:, None]
        # The median of a normal variable's size is 0.6745 of its standard deviation.
        scale = max(float(np.median(np.abs(residual))) / 0.6745, 1e-12)
        ratio = np.abs(residual).max(axis=1) / (_BISQUARE * scale)
        kept = np.where(ratio < 1.0, (1.0 - ratio**2) ** 2, 0.0)
        weight = base * kept
    # A sandwich, since the last weights depend on the residuals: (A^T W A)^-1 A^T W^2 S A (A^T W A)^-1.
    normal = design.T @ (weight[:, None] * design)
    noise = design.T @ ((weight**2 * spread**2)[:, None] * design)
    inverse = np.linalg.inv(normal)
    variance = float((inverse @ noise @ inverse)[0, 0]) * max(1.0, scale**2)
    jacobian = np.asarray(coefficients[1:3].T / reach, dtype=np.float64)
    return np.asarray(coefficients[0], dtype=np.float64), variance, jacobian
