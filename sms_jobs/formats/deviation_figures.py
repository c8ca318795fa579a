"""The picture of a deviation: green within the tolerance, blue below, red above it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sms_jobs.formats.figures import DOTS_PER_INCH, MISSING_COLOUR, as_png, in_pixels, new_figure, reduced
from sms_jobs.records.surfaces import DeviationField

_BELOW = ("#08306b", "#2171b5", "#9ecae1")
_WITHIN = ("#b8dfb0", "#dff2d8", "#b8dfb0")
_ABOVE = ("#fdae6b", "#e6550d", "#7f2704")


def band_edges(lower_mm: float, upper_mm: float) -> NDArray[np.float64]:
    """Return the edges of the colours, (10,) in mm: thirds of the tolerance, and as far beyond it twice.

    The last colour on each side goes on for ever.
    """
    width = upper_mm - lower_mm
    return np.concatenate(
        [
            lower_mm - width * np.array([1.5, 1.0, 0.5]),
            np.linspace(lower_mm, upper_mm, 4),
            upper_mm + width * np.array([0.5, 1.0, 1.5]),
        ]
    )


def draw_deviation(field: DeviationField, width_px: int = 900) -> bytes:
    """Draw the signed deviation of a camera's view as PNG, with its numbers in the title."""
    from matplotlib.colors import BoundaryNorm, ListedColormap

    rows, columns = field.deviation.shape
    width = width_px / DOTS_PER_INCH
    height = min(max((width - 1.7) * rows / columns + 1.1, 0.4 * width), 1.6 * width)
    figure = new_figure(width, height)
    axes = figure.add_subplot()
    edges = band_edges(field.lower_mm, field.upper_mm)
    colours = ListedColormap([*_BELOW, *_WITHIN, *_ABOVE]).with_extremes(bad=MISSING_COLOUR)
    shown = np.clip(reduced(field.deviation, 2 * width_px), edges[0], np.nextafter(edges[-1], -np.inf))
    drawn = axes.imshow(
        np.ma.masked_invalid(shown),
        cmap=colours,
        norm=BoundaryNorm(edges, len(edges) - 1),
        extent=(-0.5, columns - 0.5, rows - 0.5, -0.5),
        interpolation="none",
    )
    in_pixels(axes, (rows, columns))
    axes.set_title(_title(field), fontsize="medium")
    bar = figure.colorbar(
        drawn, ax=axes, label="deviation [mm], positive outside", ticks=edges, extend="both"
    )
    bar.ax.set_yticklabels([f"{edge:+.3g}" for edge in edges])
    return as_png(figure)


def write_deviation_map(field: DeviationField, path: Path) -> None:
    """Write the picture of a deviation as PNG."""
    path.write_bytes(draw_deviation(field))


def _title(field: DeviationField) -> str:
    known = field.deviation[np.isfinite(field.deviation)]
    if known.size == 0:
        return f"{field.camera}: no point of the reference surface was seen"
    shares = [100.0 * np.count_nonzero(field.verdict == v) / known.size for v in (1, 2, 3)]
    return (
        f"{field.camera}: mean {known.mean():+.3g} mm, rms {np.sqrt(np.mean(known**2)):.3g} mm\n"
        f"tolerance {field.lower_mm:+g} .. {field.upper_mm:+g} mm: within {shares[0]:.1f} %, "
        f"undecided {shares[1]:.1f} %, outside {shares[2]:.1f} %"
    )
