"""Reference surfaces from the files of CAD programs: triangles in STL, PLY or OBJ."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.interchange.text_files import read_bytes
from sms_jobs.formats.mesh_files import Mesh, read_obj, read_ply, read_stl
from sms_jobs.metrology.surfaces.triangle_surface import triangle_surface
from sms_jobs.records.surfaces import ReferenceSurface

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4, "um": 1e-3}
_READABLE = (".stl", ".ply", ".obj")
_MOST_TRIANGLES = 10_000_000
_LARGEST_BYTES = 2 << 30
_FARTHEST_MM = 1e7
_EXACT = (".step", ".stp", ".iges", ".igs", ".sldprt", ".catpart", ".x_t", ".prt", ".jt")


def read_reference_surface(path: Path, unit: str = "mm", turn_over: bool = False) -> ReferenceSurface:
    """Read the triangles of a file.

    Parameters
    ----------
    path
        STL, ASCII or binary, PLY, or OBJ; polygons with four corners become two triangles.
    unit
        In which the file counts, one of `UNITS_MM`: none of these formats says it.
    turn_over
        Whether to turn the triangles over, for a file whose triangles face inwards.

    Raises
    ------
    NotFound
        There is no such file.
    InvalidInput
        It is of another format, damaged, or has no triangle with an area.
    """
    if unit not in UNITS_MM:
        raise InvalidInput(f"the unit of a surface is one of {', '.join(UNITS_MM)}, not '{unit}'")
    suffix = path.suffix.lower()
    if suffix in _EXACT:
        raise InvalidInput(
            f"{path.name} holds exact surfaces, which only CAD programs read: save the part there as STL, "
            "with a chord error of a tenth of the tolerance"
        )
    if suffix not in _READABLE:
        raise InvalidInput(f"{path.name} is no surface that can be read: give a {', '.join(_READABLE)} file")
    vertices, faces = _read(path, suffix)
    if len(faces) > _MOST_TRIANGLES:
        raise InvalidInput(
            f"{path.name} has {len(faces):,} triangles and a reference surface takes {_MOST_TRIANGLES:,} at "
            "most: save it with a larger chord error"
        )
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise InvalidInput(f"{path.name} has no triangle, or one whose corners are missing: save it again")
    if turn_over:
        faces = faces[:, ::-1]
    vertices = vertices * UNITS_MM[unit]
    if (np.abs(vertices) > _FARTHEST_MM).any():
        raise InvalidInput(
            f"{path.name} has a corner that is more than {_FARTHEST_MM / 1e6:g} km away; correct the file, "
            "or give its `unit`"
        )
    # Refuses what cannot be measured against.
    triangle_surface(vertices, faces)
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return ReferenceSurface(
        path.name,
        digest,
        unit,
        turn_over,
        np.ascontiguousarray(vertices),
        np.ascontiguousarray(faces, np.int32),
    )


def _read(path: Path, suffix: str) -> Mesh:
    content = read_bytes(path, "reference surface", _LARGEST_BYTES)
    try:
        with np.errstate(all="ignore"):
            return {".stl": read_stl, ".ply": read_ply, ".obj": read_obj}[suffix](content)
    except (ValueError, OverflowError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InvalidInput(f"{path.name} is no whole {suffix[1:].upper()} file ({reason})") from error
