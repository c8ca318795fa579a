"""The surface of a CAD program that a campaign is compared with."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.jobs.archiving.surfaces import register_surface
from sms_jobs.records.people import Right


@dataclass(frozen=True)
class ImportedSurface:
    """A reference surface.

    Attributes
    ----------
    file, new
        Its number, and whether it was not there before.
    filename, sha256
        Of the file that it came from.
    triangles, size_mm
        How many it has, and its extent along x, y and z.
    """

    file: int
    new: bool
    filename: str
    sha256: str
    triangles: int
    size_mm: tuple[float, float, float]


@use_case(Right.COMPUTE)
def import_surface(
    services: Services, campaign: str, file: Path, *, unit: str = "mm", turn_over: bool = False
) -> ImportedSurface:
    """Store the surface that a campaign's shapes are compared with; the newest one counts.

    Parameters
    ----------
    file
        STL, PLY or OBJ.
    unit
        Of the file: mm, cm, m, um or inch.
    turn_over
        Its triangles face inwards: turn them over.

    Raises
    ------
    InvalidInput
        The file cannot be read, or there is no such unit.
    NotFound
        There is no such campaign.
    """
    # Which loads kernels; whoever lists commands would wait for them.
    from sms_jobs.formats.reference_surfaces import read_reference_surface

    found = read_reference_surface(file, unit, turn_over)
    number, new = register_surface(services.catalogue, services.archive, campaign, found, datetime.now(UTC))
    x, y, z = (float(v) for v in found.vertices.max(axis=0) - found.vertices.min(axis=0))
    return ImportedSurface(number, new, found.filename, found.file_sha256, len(found.faces), (x, y, z))
