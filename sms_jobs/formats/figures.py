"""Pictures of what is measured: maps over an image, points and meshes, as PNG.

Matplotlib's object-oriented interface with its Agg canvas: no window, no global state, safe in any thread. It
is imported by the functions that draw, because it takes a while and most commands draw nothing.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.drawing.colours import GREYS, VALUES, coloured
from sms_jobs.records.quantity import XYZ, Quantity, quantities, quantities_of
from sms_jobs.records.reasons import Reason

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAGNITUDE = "magnitude"
DOTS_PER_INCH = 100
MISSING_COLOUR = "0.75"
COLOUR_MAP = "viridis"
GREY_LEVELS = "gray"
LIMIT_PERCENTILES = (1.0, 99.0)
"""Colours span the middle 98 % of the values: a few wild pixels must not flatten the rest."""

_PACKING = 3
_FLAT = 1e-6  # ten times the rounding of single precision


@dataclass(frozen=True)
class Map:
    """A scalar over an image, ready to be drawn.

    Attributes
    ----------
    values
        (rows, columns), NaN where there is none; may be smaller than the image.
    size
        (rows, columns) of the image.
    title, unit
        As they are shown.
    outlines
        Label map of the same shape as `values` whose borders are drawn, or None.
    behind
        Grey levels of the image, (rows, columns), shown where there is no value; None for plain grey.
    """

    values: NDArray[Any]
    size: tuple[int, int]
    title: str
    unit: str
    outlines: NDArray[Any] | None = None
    behind: NDArray[Any] | None = None


def reduced(values: NDArray[Any], longest: int) -> NDArray[Any]:
    """Shrink an image by a whole factor so that no side is longer than `longest`.

    Floats are averaged over what is there of each block, NaN where nothing is; integers, which may be
    labels or flags, are sampled.
    """
    rows, columns = values.shape
    factor = -(-max(rows, columns) // longest)
    if factor <= 1:
        return values
    if values.dtype.kind != "f":
        return values[factor // 2 :: factor, factor // 2 :: factor]
    padded = np.full((-(-rows // factor) * factor, -(-columns // factor) * factor), np.nan, np.float32)
    padded[:rows, :columns] = values
    blocks = padded.reshape(padded.shape[0] // factor, factor, -1, factor)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    mean: NDArray[Any] = np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)
    return mean


def robust_limits(values: NDArray[Any]) -> tuple[float, float]:
    """Return the ends of the colour scale, from the values that are there; (0, 1) if there are none.

    A flat field gets some room on both sides, so that its rounding is not made to look like a pattern.
    """
    known = values[np.isfinite(values)]
    if known.size == 0:
        return 0.0, 1.0
    low, high = (float(p) for p in np.percentile(known, LIMIT_PERCENTILES))
    largest = max(abs(low), abs(high))
    if high - low <= _FLAT * largest:
        margin = 0.01 * largest or 1.0
        return low - margin, high + margin
    return low, high


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=DOTS_PER_INCH, layout="compressed", facecolor="white")


def as_png(figure: Figure) -> bytes:
    """Return a figure as PNG. The same picture has the same bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    buffer = io.BytesIO()
    # Not by the figure's own `savefig`: it draws what is laid out twice, keeps a fourth channel that is the
    # same everywhere, and packs twice as long for 6 % less.
    opaque = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    opaque.save(buffer, "PNG", compress_level=_PACKING, dpi=(DOTS_PER_INCH, DOTS_PER_INCH))
    return buffer.getvalue()


def _label(title: str, unit: str) -> str:
    return title if unit in ("1", "bit", "") else f"{title} [{unit}]"


def in_pixels(axes: Axes, size: tuple[int, int]) -> None:
    """Give axes the frame of an image of (rows, columns): y down, square pixels."""
    axes.set_xlim(-0.5, size[1] - 0.5)
    axes.set_ylim(size[0] - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("x [px]")
    axes.set_ylabel("y [px]")


def draw_map(image: Map, width_px: int = 640) -> bytes:
    """Draw a scalar over an image as PNG, `width_px` wide: colour bar with unit, missing values grey."""
    import matplotlib

    rows, columns = image.size
    width = width_px / DOTS_PER_INCH
    # Labels and colour bar take about 1.45 inches of the width; title and labels 0.85 of the height.
    height = min(max((width - 1.45) * rows / columns + 0.85, 0.4 * width), 1.6 * width)
    figure = new_figure(width, height)
    axes = figure.add_subplot()
    colours = matplotlib.colormaps[GREY_LEVELS if image.unit == "count" else COLOUR_MAP]
    colours = colours.with_extremes(bad=MISSING_COLOUR if image.behind is None else "none")
    low, high = robust_limits(image.values)
    extent = (-0.5, columns - 0.5, rows - 0.5, -0.5)
    if image.behind is not None:
        dark, bright = robust_limits(image.behind)
        axes.imshow(image.behind, cmap=GREY_LEVELS, vmin=dark, vmax=bright, extent=extent)
    drawn = axes.imshow(
        np.ma.masked_invalid(image.values),
        cmap=colours,
        vmin=low,
        vmax=high,
        extent=extent,
        interpolation="none",
    )
    if image.outlines is not None:
        _draw_borders(axes, image.outlines, image.size)
    in_pixels(axes, image.size)
    axes.set_title(image.title, fontsize="medium")
    figure.colorbar(drawn, ax=axes, label=f"[{image.unit}]" if image.unit != "1" else "[-]", extend="both")
    return as_png(figure)


def colours_as_png(values: NDArray[Any], unit: str) -> bytes:
    """Return a scalar (rows, columns) as PNG with a pixel for each value: missing ones grey, no frame."""
    from PIL import Image

    low, high = robust_limits(values)
    shown = coloured((values - low) / (high - low), GREYS if unit == "count" else VALUES)
    shown[~np.isfinite(values)] = round(255 * float(MISSING_COLOUR))
    out = io.BytesIO()
    Image.fromarray(shown).save(out, format="PNG", compress_level=1)
    return out.getvalue()


def _draw_borders(axes: Axes, labels: NDArray[Any], size: tuple[int, int]) -> None:
    """Draw a line around every label, 0 excepted."""
    x = (np.arange(labels.shape[1]) + 0.5) * size[1] / labels.shape[1] - 0.5
    y = (np.arange(labels.shape[0]) + 0.5) * size[0] / labels.shape[0] - 0.5
    for label in np.unique(labels[labels > 0]):
        inside = (labels == label).astype(np.float32)
        if min(inside.shape) > 1 and inside.min() < inside.max():
            axes.contour(x, y, inside, [0.5], colors=["#ff5a36"], linewidths=1.2)


def _draw_reasons(reasons: NDArray[Any], title: str, width_px: int) -> bytes:
    """Draw the first reason of every pixel, with its name in the colour bar."""
    import matplotlib
    from matplotlib.colors import BoundaryNorm, ListedColormap

    lowest = (reasons & (~reasons + 1)).astype(np.int64)
    present = [int(flag) for flag in np.unique(lowest)]
    names = [Reason(flag).name or str(flag) if flag else "VALID" for flag in present]
    palette = matplotlib.colormaps["tab20"].colors  # type: ignore[attr-defined]
    colours = ["0.92" if not flag else palette[flag.bit_length() % len(palette)] for flag in present]
    figure = new_figure(width_px / DOTS_PER_INCH, 0.75 * width_px / DOTS_PER_INCH)
    axes = figure.add_subplot()
    places = np.searchsorted(present, lowest)
    norm = BoundaryNorm(np.arange(len(present) + 1) - 0.5, len(present))
    rows, columns = reasons.shape
    drawn = axes.imshow(
        places,
        cmap=ListedColormap(colours),
        norm=norm,
        extent=(-0.5, columns - 0.5, rows - 0.5, -0.5),
        interpolation="none",
    )
    in_pixels(axes, (rows, columns))
    axes.set_title(title, fontsize="medium")
    bar = figure.colorbar(drawn, ax=axes, ticks=np.arange(len(present)))
    bar.ax.set_yticklabels(names, fontsize="x-small")
    return as_png(figure)


def _draw_points(record: Any, values: NDArray[Any], title: str, unit: str, width_px: int) -> bytes:
    """Draw values at points of an image, or of a mesh seen along Z."""
    if not (hasattr(record, "vertices") or hasattr(record, "x")):
        raise InvalidInput(
            f"a {type(record).__name__} is neither an image nor a mesh, and cannot be plotted; "
            "'sms data show' lists its contents"
        )
    figure = new_figure(width_px / DOTS_PER_INCH, 0.8 * width_px / DOTS_PER_INCH)
    axes = figure.add_subplot()
    low, high = robust_limits(values)
    if hasattr(record, "vertices"):
        x, y = record.vertices[:, 0], record.vertices[:, 1]
        names = (f"X [{record.unit}]", f"Y [{record.unit}]")
    else:
        x, y, names = record.x, record.y, ("x [px]", "y [px]")
        axes.invert_yaxis()
    size = float(np.clip(4000.0 / max(len(x), 1), 0.5, 20.0))
    drawn = axes.scatter(
        x, y, c=values, s=size, marker="s", cmap=COLOUR_MAP, vmin=low, vmax=high, plotnonfinite=False
    )
    axes.set_aspect("equal")
    axes.set_xlabel(names[0])
    axes.set_ylabel(names[1])
    axes.set_title(title, fontsize="medium")
    figure.colorbar(drawn, ax=axes, label=_label("", unit).strip(), extend="both")
    return as_png(figure)


def _components(record: Any, quantity: Quantity, count: int) -> tuple[str, ...]:
    if quantity.axes[0] == "value":
        return tuple(record.value_names)
    return quantity.components or tuple(str(i) for i in range(count))


def _default_component(name: str, quantity: Quantity, names: tuple[str, ...]) -> str:
    """Return the last of a position, Z if it has one, the magnitude of any other vector, else the first."""
    if quantity.components not in (XYZ, XYZ[:2]):
        return names[0]
    return names[-1] if name == "position" else MAGNITUDE


def _chosen(record: Any, name: str, quantity: Quantity, component: str | None) -> tuple[Any, str, str]:
    """Return one scalar field of an array: its values, the component's name, and the unit."""
    values = getattr(record, name)
    plain = len(quantity.axes) == (2 if quantity.is_image else 1)
    if plain:
        if component is not None:
            raise InvalidInput(f"{name} has no components, so there is no '{component}'; leave it out")
        return values, "", quantity.unit
    names = _components(record, quantity, values.shape[0])
    chosen = _default_component(name, quantity, names) if component is None else component
    if chosen == MAGNITUDE and quantity.axes[0] == "component":
        return np.sqrt(np.sum(np.asarray(values, np.float64) ** 2, axis=0)), MAGNITUDE, quantity.unit
    if chosen not in names:
        known = ", ".join((*names, MAGNITUDE) if quantity.axes[0] == "component" else names)
        raise InvalidInput(f"{name} has no component '{chosen}'; choose one of {known}")
    index = names.index(chosen)
    unit = record.value_units[index] if quantity.axes[0] == "value" else quantity.unit
    return (values.frame(index) if quantity.axes[0] == "frame" else values[index]), chosen, unit


def plottable(record: type) -> tuple[str, ...]:
    """Return the fields of a record class that can be drawn, in order of declaration."""
    found = []
    for name, quantity in quantities(record).items():
        image = quantity.is_image and len(quantity.axes) <= 3
        points = quantity.axes[-1:] in (("point",), ("vertex",)) and len(quantity.axes) <= 2
        if image or (points and name not in ("x", "y")):
            found.append(name)
    return tuple(found)


def plot_record(
    record: Any,
    field: str | None = None,
    component: str | None = None,
    width_px: int = 900,
    behind: NDArray[Any] | None = None,
) -> bytes:
    """Draw one field of a record as PNG.

    Parameters
    ----------
    record
        Any record with fields over an image, over points of an image, or over vertices.
    field
        Name of the field; the first that can be drawn if None.
    component
        Name of the component, number of the frame, or "magnitude"; if None, Z of a position, the magnitude
        of any other vector in the world, else the first.
    width_px
        Width of the picture in pixels.
    behind
        Grey levels of the image that the record is over, shown where the field has no value.

    Raises
    ------
    InvalidInput
        When the record has no such field or component, or none that can be drawn.
    """
    kind = type(record).__name__
    names = [n for n in plottable(type(record)) if getattr(record, n) is not None]
    if not names:
        raise InvalidInput(f"a {kind} has nothing that can be drawn")
    if field is not None and field not in names:
        raise InvalidInput(f"a {kind} has no field '{field}' to draw; choose one of {', '.join(names)}")
    name = field or names[0]
    quantity = quantities_of(record)[name]
    values, chosen, unit = _chosen(record, name, quantity, component)
    title = f"{quantity.meaning}, {chosen}" if chosen else quantity.meaning
    if not quantity.is_image:
        return _draw_points(record, values, title, unit, width_px)
    if unit == "bit":
        return _draw_reasons(values, title, width_px)
    small = reduced(np.asarray(values), 2 * width_px)
    grey = None if behind is None else reduced(np.asarray(behind, np.float32), 2 * width_px)
    return draw_map(Map(small, (values.shape[0], values.shape[1]), title, unit, behind=grey), width_px)
