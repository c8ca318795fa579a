"""How a record says what one of its arrays is: unit, meaning and axes."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

QUANTITY = "quantity"

LengthUnit = Literal["mm", "px"]
"""In which a record counts lengths: the world in mm, the plane of an image in px where no scale is known."""
Axes = Literal["XYZ", "xyz"]
"""Along which axes a record has its vectors: those of the world or of an image's plane, or the specimen's."""
UNIT = "{unit}"
"""The unit of an array that is in the unit of its record."""


@dataclass(frozen=True)
class Quantity:
    """What an array of a record holds.

    Attributes
    ----------
    unit
        mm, rad, px, s, N or a product of them; "1" for a ratio; "count" for grey levels; "bit" for flags;
        `UNIT` stands for that of the record.
    meaning
        One phrase, shown in plots and stored beside the data.
    axes
        Names of the axes, slowest first. A component axis leads: a vector field over an image is
        ("component", "row", "column").
    components
        Names along the component axis, if there is one.
    in_plane
        Those names where the record lies in a plane and has no Z; empty where it cannot.
    """

    unit: str
    meaning: str
    axes: tuple[str, ...]
    components: tuple[str, ...] = ()
    in_plane: tuple[str, ...] = ()

    @property
    def is_image(self) -> bool:
        """True when the last two axes are the rows and columns of an image."""
        return self.axes[-2:] == ("row", "column")


IMAGE = ("row", "column")
XYZ = ("X", "Y", "Z")
SYMMETRIC = ("XX", "XY", "XZ", "YY", "YZ", "ZZ")
"""Order in which a symmetric 3 x 3 tensor is packed into six components."""
STRAIN_COMPONENTS = ("xx", "yy", "xy")
"""Of strain in the tangent plane of a surface."""
_IN_PLANE = {XYZ: ("X", "Y"), SYMMETRIC: ("XX", "XY", "YY")}


def array(
    unit: str, meaning: str, axes: tuple[str, ...] = IMAGE, components: tuple[str, ...] = (), **options: Any
) -> Any:
    """Declare an array field of a record; `options` go to `dataclasses.field`."""
    in_plane = _IN_PLANE.get(components, ()) if UNIT in unit else ()
    return field(metadata={QUANTITY: Quantity(unit, meaning, axes, components, in_plane)}, **options)


def quantities(record: type) -> dict[str, Quantity]:
    """Return the array fields of a record class, by name, in order of declaration."""
    return {f.name: f.metadata[QUANTITY] for f in fields(record) if QUANTITY in f.metadata}


def quantities_of(record: Any) -> dict[str, Quantity]:
    """Return what the arrays of a record hold, each in its unit; those that it has not got are left out."""
    found = {}
    for name, quantity in quantities(type(record)).items():
        values = getattr(record, name)
        if values is not None:
            unit = quantity.unit.replace(UNIT, getattr(record, "unit", ""))
            components = components_of(quantity, values.shape)
            if getattr(record, "axes", "XYZ") == "xyz":
                components = tuple(component.lower() for component in components)
            found[name] = replace(quantity, unit=unit, components=components)
    return found


def components_of(quantity: Quantity, shape: tuple[int, ...]) -> tuple[str, ...]:
    """Return the names along the component axis of an array of that shape."""
    flat = quantity.in_plane and shape[quantity.axes.index("component")] == len(quantity.in_plane)
    return quantity.in_plane if flat else quantity.components
