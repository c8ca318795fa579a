"""What maps show of a record: each quantity with its unit, its standard deviation and what it is read from.

Nothing is read here: a `Shown` names the arrays that it needs, and makes a field of the samples of them, so
that whoever asks for one quantity of a large file reads no other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.formats.report.surface import MICROSTRAIN, displacement_length, principal_sigma
from sms_jobs.records.field_names import DISPLACEMENT_LENGTH, component

Values: TypeAlias = NDArray[Any]
Source: TypeAlias = tuple[str, int | None]
"""Name of an array, and which of its components; None for an image."""

_SPREADS = {"covariance", "sigma"}
_NAMES = {
    "reason": "status",
    "von_mises": "von Mises strain",
    "sigma_calibration": "sigma from the calibration",
    "resolution": "spatial resolution",
    "ray_gap": "gap between the rays",
    "discrepancy": "disagreement of the views",
    "image_displacement": "displacement",
}
_PRINCIPAL = ("first principal strain", "second principal strain")
_ORDER = ("displacement", "strain", "deviation", "position", "texture", "omega")
"""Of what is shown first: the first array that there is of these."""


@dataclass(frozen=True)
class Reading:
    """What is read, and what becomes of it: images (rows, columns) of the sources in, one image out."""

    sources: tuple[Source, ...]
    compute: Callable[..., Values]

    def of(self, images: Mapping[Source, Values]) -> Values:
        """Return what becomes of images that were read."""
        return np.asarray(self.compute(*(images[source] for source in self.sources)))


@dataclass(frozen=True)
class Shown:
    """A quantity of a record that a map can show.

    Attributes
    ----------
    record
        Name of the record in its file.
    name, unit
        As they are shown; the unit of a ratio is "".
    quantity
        What it is a component of, as that is called; its own name where it has none.
    values, sigma
        How it is had, and its standard deviation; None where none is known.
    array, component, scale
        Where a section finds it: `scale` times that component is the quantity; None where it is derived.
    flags
        Whether it is `Reason` bits.
    """

    record: str
    name: str
    unit: str
    quantity: str
    values: Reading
    sigma: Reading | None = None
    array: str | None = None
    component: int | None = None
    scale: float = 1.0
    flags: bool = False


def shown_of(record: str, arrays: Mapping[str, Mapping[str, Any]]) -> list[Shown]:
    """Return the quantities of a record, the most telling first.

    Parameters
    ----------
    record
        Its name in the file.
    arrays
        By name, the shape, unit, axes and components of each.
    """
    images = {name: a for name, a in arrays.items() if _is_image(a) and name not in _SPREADS}
    found = [one for name, about in images.items() for one in _of_array(record, name, about, arrays)]
    return sorted(found, key=lambda one: (one.flags, _rank(one.array)))


def _rank(array: str | None) -> int:
    return _ORDER.index(array) if array in _ORDER else -1 if array is None else len(_ORDER)


def _is_image(about: Mapping[str, Any]) -> bool:
    axes = about["axes"]
    return axes[-2:] == ["row", "column"] and len(axes) <= 3 and axes[0] != "frame"


def _of_array(
    record: str, array: str, about: Mapping[str, Any], arrays: Mapping[str, Mapping[str, Any]]
) -> Iterator[Shown]:
    if array.endswith("_sigma") and array.removesuffix("_sigma") in arrays:
        return
    count = about["shape"][0] if len(about["axes"]) == 3 else None
    strains = "strain" in array or array in ("principal", "von_mises", "sigma_calibration", "bias")
    strained = about["unit"] == "1" and strains
    scale, unit = (MICROSTRAIN, "µε") if strained else (1.0, about["unit"])
    unit = "" if unit in ("1", "bit") else unit
    if array == "displacement" and "covariance" in arrays:
        yield _length(record, unit, count or 3, arrays["covariance"]["shape"][0])
    for place in (None,) if count is None else range(count):
        name, quantity = _named(array, about["components"], place)
        yield Shown(
            record,
            name,
            unit,
            quantity,
            Reading(((array, place),), _times(scale)),
            _sigma_of(array, place, scale, arrays),
            array,
            place,
            scale,
            about["unit"] == "bit",
        )


def _named(array: str, components: list[str], place: int | None) -> tuple[str, str]:
    """Return how a component of an array is called, and what it is one of."""
    quantity = _NAMES.get(array, array.replace("_", " "))
    if place is None:
        return quantity, quantity
    if array == "principal":
        return _PRINCIPAL[place], quantity
    return component(quantity, components[place] if components else str(place)), quantity


def _times(scale: float) -> Callable[[Values], Values]:
    return lambda values: values if scale == 1.0 else scale * values


def _sigma_of(
    array: str, component: int | None, scale: float, arrays: Mapping[str, Mapping[str, Any]]
) -> Reading | None:
    if f"{array}_sigma" in arrays:
        return Reading(((f"{array}_sigma", component),), _times(scale))
    if array in ("strain", "deviation") and "sigma" in arrays:
        return Reading((("sigma", component),), _times(scale))
    if array == "principal" and "sigma" in arrays:
        sources = tuple((name, k) for name in ("strain", "sigma") for k in range(3))
        return Reading(sources, _of_principal(component or 0, scale))
    of = "displacement" if "displacement" in arrays else "position"
    if array == of and component is not None and "covariance" in arrays:
        place = arrays["covariance"]["components"].index(2 * arrays[array]["components"][component])
        return Reading((("covariance", place),), lambda variance: scale * np.sqrt(variance))
    return None


def _of_principal(place: int, scale: float) -> Callable[..., Values]:
    def compute(*images: Values) -> Values:
        strain, sigma = np.stack(images[:3]), np.stack(images[3:])
        return principal_sigma(scale * strain, scale * sigma)[place]

    return compute


def _length(record: str, unit: str, axes: int, covariances: int) -> Shown:
    """Return the length of the displacement."""
    moved = tuple(("displacement", k) for k in range(axes))
    spread = tuple(("covariance", k) for k in range(covariances))

    def sigma(*images: Values) -> Values:
        return displacement_length(np.stack(images[:axes]), np.stack(images[axes:]))[1]

    return Shown(
        record,
        DISPLACEMENT_LENGTH,
        unit,
        DISPLACEMENT_LENGTH,
        Reading(moved, lambda *images: np.sqrt(sum(image**2 for image in images))),
        Reading((*moved, *spread), sigma),
    )
