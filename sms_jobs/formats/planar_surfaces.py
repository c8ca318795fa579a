"""Results in the plane of an image as surfaces, for programs that want points: flat, seen as the camera does.

X points to the right and Y up, from the middle of the first pixel, in mm where the size of a pixel is known
and in px elsewhere; Z is 0. So Y is minus the row, and nothing is mirrored in a viewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.formats.exporters.exporter import TEXTURE, PlanarMesh, PointGrid
from sms_jobs.records.planar import PlanarDisplacement, PlanarStrain
from sms_jobs.records.reasons import Reason

_STRAINS = ("xx", "yy", "xy")
_Value: TypeAlias = tuple[str, str, str, NDArray[np.floating]]
"""The record's array that a value is made of, its name, its unit, and itself."""


def planar_grid(
    moved: PlanarDisplacement | None,
    strain: PlanarStrain | None,
    texture: NDArray[np.floating] | None = None,
    chosen: Sequence[str] = (),
) -> PointGrid:
    """Return displacement and strain of a tuple, either or both, over the pixels where anything is known.

    Parameters
    ----------
    moved, strain
        Of one tuple; at least one of them.
    texture
        (rows, columns), 0 .. 1, of the reference image; None if it is not known.
    chosen
        Names of arrays of the records, as "displacement" or "sigma"; empty for all.
    """
    one = moved if moved is not None else strain
    assert one is not None
    scale, unit = (1.0, "px") if one.mm_per_px is None else (one.mm_per_px, "mm")
    known: NDArray[np.bool_] = np.zeros(one.reason.shape, dtype=bool)
    values: list[_Value] = []
    if moved is not None:
        known |= moved.reason == Reason.VALID
        values += _displacements(moved, scale, unit)
    if strain is not None:
        known |= strain.reason == Reason.VALID
        values += _strains(strain)
    kept = [value for value in values if not chosen or value[0] in chosen]
    rows, columns = one.reason.shape
    xyz = np.zeros((3, rows, columns))
    xyz[0], xyz[1] = scale * np.arange(columns)[None, :], -scale * np.arange(rows)[:, None]
    xyz[:, ~known] = np.nan
    stacked = np.stack([value[3] for value in kept]) if kept else np.zeros((0, rows, columns))
    names = tuple(name for _, name, _, _ in kept)
    units = tuple(unit for _, _, unit, _ in kept)
    return PointGrid(xyz, names, units, stacked, texture, unit)


def _displacements(moved: PlanarDisplacement, scale: float, unit: str) -> list[_Value]:
    u, v = scale * moved.displacement[0], scale * moved.displacement[1]
    sigma_u, sigma_v = scale * moved.sigma[0], scale * moved.sigma[1]
    of = "displacement_mm" if unit == "mm" else "displacement"
    return [
        (of, "displacement X", unit, u),
        (of, "displacement Y", unit, -v),
        (of, "displacement", unit, np.hypot(u, v)),
        ("sigma", "sigma of displacement X", unit, sigma_u),
        ("sigma", "sigma of displacement Y", unit, sigma_v),
    ]


def _strains(strain: PlanarStrain) -> list[_Value]:
    return [
        *(("strain", f"strain {n}", "1", e) for n, e in zip(_STRAINS, strain.strain, strict=True)),
        *(("sigma", f"sigma of strain {n}", "1", s) for n, s in zip(_STRAINS, strain.sigma, strict=True)),
        ("principal", "principal first", "1", strain.principal[0]),
        ("principal", "principal second", "1", strain.principal[1]),
        ("von_mises", "von_mises", "1", strain.von_mises),
    ]


def planar_mesh(grid: PointGrid, step_px: int = 1) -> PlanarMesh:
    """Return triangles between the neighbouring points of a flat grid, every `step_px` pixels.

    All that is known hangs together: there is no shape that could tell discontinuities.
    """
    # Imports kernels, which a format for any record need not wait for.
    from sms_jobs.metrology.surfaces.meshing import triangulate_image

    pixels, faces = triangulate_image(np.isfinite(grid.xyz[0]).astype(np.int32), step_px)
    row, column = pixels.T
    names, units = grid.value_names, grid.value_units
    values = np.asarray(grid.values[:, row, column], np.float64)
    if grid.texture is not None:
        names, units = (*names, TEXTURE), (*units, "1")
        values = np.concatenate([values, np.asarray(grid.texture[row, column], np.float64)[None]])
    return PlanarMesh(
        names, units, np.ascontiguousarray(grid.xyz[:, row, column].T), faces, values, grid.length_unit
    )
