"""How a record says what one of its arrays is: unit, meaning and axes."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

QUANTITY = "quantity"


@dataclass(frozen=True)
class Quantity:
    """What an array of a record holds.

    Attributes
    ----------
    unit
        mm, rad, px, s, N or a product of them; "1" for a ratio; "count" for grey levels; "bit" for flags.
    meaning
        One phrase, shown in plots and stored beside the data.
    axes
        Names of the axes, slowest first. A component axis leads: a vector field over an image is
        ("component", "row", "column").
    components
        Names along the component axis, if there is one.
    """

    unit: str
    meaning: str
    axes: tuple[str, ...]
    components: tuple[str, ...] = ()

    @property
    def is_image(self) -> bool:
        """True when the last two axes are the rows and columns of an image."""
        return self.axes[-2:] == ("row", "column")


IMAGE = ("row", "column")
XYZ = ("X", "Y", "Z")
SYMMETRIC = ("XX", "XY", "XZ", "YY", "YZ", "ZZ")
"""Order in which a symmetric 3 x 3 tensor is packed into six components."""


def array(
    unit: str, meaning: str, axes: tuple[str, ...] = IMAGE, components: tuple[str, ...] = (), **options: Any
) -> Any:
    """Declare an array field of a record; `options` go to `dataclasses.field`."""
    return field(metadata={QUANTITY: Quantity(unit, meaning, axes, components)}, **options)


def quantities(record: type) -> dict[str, Quantity]:
    """Return the array fields of a record class, by name, in order of declaration."""
    return {f.name: f.metadata[QUANTITY] for f in fields(record) if QUANTITY in f.metadata}
