"""Draws dots of any outline as a lens and pixels blur them, and finds where ellipses fitted to them are."""

from __future__ import annotations

from math import ceil, pi

import numpy as np

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import kernel
from sms_jobs.metrology.targets.ellipse_fit import fit_ellipses

_MARGIN_PX = 5  # about an outline: the fit takes no grey level farther out than three pixels, or widths
_STEP_OVER_BLUR = 1.0  # along an outline: the sum over it is then exact to exp(-2 pi^2)


def outline_points(radius_px: float, blur_px: float) -> int:
    """Return at how many places the outline of a dot is to be known for its image to be exact."""
    return ceil(2.0 * pi * radius_px / (_STEP_OVER_BLUR * blur_px))


@kernel
def _draw(outline: Floats, blur: float, image: Singles) -> None:  # pragma: no cover - compiled
    """Fill images (n, side, side) with how much of each blurred pixel lies in an outline (n, points, 2).

    By Green's theorem that is the integral of (1 - exp(-r^2 / 2 s^2)) / (2 pi r^2) (r x dr) along the
    outline, seen from the pixel: an area under a normal distribution of the standard deviation s.
    """
    count, points, _ = outline.shape
    for n in range(count):
        for y in range(image.shape[1]):
            for x in range(image.shape[2]):
                total = 0.0
                for k in range(points):
                    before, after = outline[n, k - 1], outline[n, (k + 1) % points]
                    px, py = outline[n, k, 0] - x, outline[n, k, 1] - y
                    square = px * px + py * py
                    turn = 0.5 * (px * (after[1] - before[1]) - py * (after[0] - before[0]))
                    part = square / (2.0 * blur * blur)
                    if part < 1e-9:
                        total += turn / (2.0 * blur * blur)
                    elif part < 40.0:
                        total += turn * (1.0 - np.exp(-part)) / square
                    else:
                        total += turn / square
                image[n, y, x] = total / (2.0 * np.pi)


def fitted_centres(outline: Floats, matrix: Floats, blur_px: float, reach_px: Floats) -> Floats:
    """Return the centres (n, 2) of the ellipses that `fit_ellipses` finds of dots with given outlines.

    Parameters
    ----------
    outline
        (n, points, 2) in px, evenly along a parameter of each outline, x towards y; see `outline_points`.
    matrix
        (n, 2, 2) in 1/px, of ellipses |M (x - c)| = 1 about the means of the outlines to begin with.
    blur_px
        Standard deviation of the blur of lens and pixel together.
    reach_px
        (n,), how far from the edge grey levels inside are taken.

    Returns
    -------
    NaN where no ellipse fits.
    """
    corner = np.floor(outline.min(axis=1)) - _MARGIN_PX
    side = int(np.ceil((outline.max(axis=1) - corner).max())) + _MARGIN_PX + 1
    image = np.empty((len(outline), side, side), np.float32)
    _draw(np.ascontiguousarray(outline - corner[:, None]), blur_px, image)
    below = np.stack([np.zeros(len(outline)), side * np.arange(len(outline))], axis=-1)
    start = outline.mean(axis=1) - corner + below
    found = fit_ellipses(image.reshape(-1, side), start, matrix, reach_px, np.full(len(outline), 12.0))
    return np.asarray(found.centre - below + corner)
