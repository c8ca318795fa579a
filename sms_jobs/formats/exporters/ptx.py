"""PTX: the points of one view in the order of its image, with grey.

The format has no unit: here mm, or px of a flat image whose scale is not known.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sms_jobs.formats.exporters.exporter import Exporter, PointGrid, grey, write_rows

_NO_TEXTURE = 0.5
_HEADER = """0 0 0
1 0 0
0 1 0
0 0 1
1 0 0 0
0 1 0 0
0 0 1 0
0 0 0 1
"""
"""The scanner at the origin and the identity as its transform: positions are in the world's frame already."""


def write(grid: PointGrid, path: Path) -> None:
    """Write columns from the left, each from its lowest row upwards; a missing point is 0 0 0 0."""
    known = grid.valid()
    texture = np.full(known.shape, _NO_TEXTURE) if grid.texture is None else grey(grid.texture)
    rows, columns = known.shape
    with path.open("w", encoding="ascii") as file:
        file.write(f"{columns}\n{rows}\n{_HEADER}")
        for column in range(columns):
            there = known[::-1, column]
            xyz = np.where(there, grid.xyz[:, ::-1, column], 0.0)
            level = np.where(there, texture[::-1, column], 0.0)
            write_rows(file, [*xyz, level], "%.9g %.9g %.9g %.4f")


EXPORTER = Exporter(
    "ptx",
    "points in the order of the image, with texture as grey",
    ".ptx",
    "text/plain",
    write,
    (PointGrid,),
)
