"""What an exporter is, and what all of them ask of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import MeasurementFailed
from sms_jobs.records.fields import Mesh


@dataclass(frozen=True)
class Exporter:
    """A way to write a mesh for other programs.

    Attributes
    ----------
    name, summary
        As a person chooses it.
    suffix, media_type
        Of the files that it makes.
    write
        Fills the file at a path.
    """

    name: str
    summary: str
    suffix: str
    media_type: str
    write: Callable[[Mesh, Path], None]


def faces_of(mesh: Mesh) -> NDArray[np.int32]:
    """Return the faces of a mesh, (faces, 3); raise `MeasurementFailed` if there is none to write."""
    if len(mesh.faces) == 0:
        raise MeasurementFailed("the mesh has no face: there is nothing to export")
    return mesh.faces


def labels_of(mesh: Mesh) -> list[str]:
    """Return the names of a mesh's values with their units, fit to stand between quotation marks."""
    pairs = zip(mesh.value_names, mesh.value_units, strict=True)
    return [f"{name} [{unit}]".replace('"', "'").replace("\n", " ") for name, unit in pairs]
