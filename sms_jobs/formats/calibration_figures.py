"""Pictures of a calibration: residuals over a sensor's image, and the expected deviation in the volume."""

from __future__ import annotations

import numpy as np

from sms_jobs.formats.figures import COLOUR_MAP, DOTS_PER_INCH, as_png, in_pixels, new_figure, robust_limits
from sms_jobs.metrology.arrays import Floats

_ARROW_PART = 0.05
"""Length of a typical arrow as a part of the image's width."""


def draw_residuals(
    place: Floats, residual: Floats, size: tuple[int, int], title: str, width_px: int
) -> bytes:
    """Draw residuals as arrows over an image, as PNG.

    Parameters
    ----------
    place, residual
        (n, 2) in px.
    size
        (rows, columns) of the image.
    title
        The scale of the arrows is added to it.
    width_px
        Of the picture.
    """
    rms = float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))) if len(residual) else 0.0
    stretch = _ARROW_PART * size[1] / rms if rms > 0.0 else 1.0
    figure = new_figure(width_px / DOTS_PER_INCH, 0.85 * width_px / DOTS_PER_INCH)
    axes = figure.add_subplot()
    axes.quiver(
        place[:, 0],
        place[:, 1],
        residual[:, 0] * stretch,
        residual[:, 1] * stretch,
        np.hypot(residual[:, 0], residual[:, 1]),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        cmap=COLOUR_MAP,
        width=0.003,
    )
    in_pixels(axes, size)
    axes.set_title(f"{title}: rms {rms:.3g} px, arrows x {stretch:.3g}", fontsize="medium")
    return as_png(figure)


def draw_expected_sigma(place: Floats, sigma_mm: Floats, title: str, width_px: int) -> bytes:
    """Draw the expected standard deviation of points on three levels of Z, as PNG.

    `place` (n, 3) in mm is a regular grid; `sigma_mm` (n,).
    """
    levels = np.unique(place[:, 2])
    chosen = levels[[0, len(levels) // 2, -1]] if len(levels) > 2 else levels
    micrometres = 1e3 * sigma_mm
    low, high = robust_limits(micrometres)
    figure = new_figure(width_px / DOTS_PER_INCH, 0.42 * width_px / DOTS_PER_INCH)
    grids = figure.subplots(1, len(chosen), sharey=True, squeeze=False)[0]
    for axes, level in zip(grids, chosen, strict=True):
        here = place[:, 2] == level
        x, y, value = place[here, 0], place[here, 1], micrometres[here]
        if np.linalg.matrix_rank(place[here] - place[here][0]) > 1:
            levels_of = {"levels": np.linspace(low, high, 13), "extend": "both"}
            drawn = axes.tricontourf(x, y, value, cmap=COLOUR_MAP, **levels_of)
        else:
            # Places on one line, at a corner of the volume that both sensors just see, enclose no area.
            drawn = axes.scatter(x, y, c=value, vmin=low, vmax=high, cmap=COLOUR_MAP)
        axes.set_aspect("equal")
        axes.set_title(f"Z = {level:.0f} mm", fontsize="small")
        axes.set_xlabel("X [mm]")
    grids[0].set_ylabel("Y [mm]")
    figure.suptitle(title, fontsize="medium")
    figure.colorbar(drawn, ax=list(grids), label="[um]", extend="both")
    return as_png(figure)
