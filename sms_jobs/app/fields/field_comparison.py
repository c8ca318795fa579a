"""Displacement against a calculation or against another measurement."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.other_fields import PointField, draw_difference, read_point_field
from sms_jobs.kinds.products import MESH
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.geometry.planes import in_space
from sms_jobs.records.field_names import DISPLACEMENT_SIGMA, DISPLACEMENT_XYZ, SIGMA_CALIBRATION
from sms_jobs.records.people import Right

_AXES = ("X", "Y", "Z")


@dataclass(frozen=True)
class ComparisonOptions:
    """How two displacements are compared.

    Attributes
    ----------
    field
        Displacement in a mesh file; if it is None, the only one with three components.
    scale_mm
        Length of the mesh file's unit in mm.
    align
        Lay the other shape on this one first: they have two frames.
    free
        Leave out the rigid motion that they differ by.
    within_mm
        Points with nothing of the other within this are left out.
    """

    field: str | None
    scale_mm: float
    align: bool
    free: bool
    within_mm: float


@dataclass(frozen=True)
class Difference:
    """A measured displacement minus another.

    Attributes
    ----------
    points
        (n, 3) in mm.
    difference
        (n, 3) in mm, (n, 2) where what was measured lies in the plane of an image; NaN where the other has
        nothing near.
    sigma
        (n,), stated of the measured displacement, in mm.
    sigma_calibration
        (n,), what the calibration of the measured displacement adds to it, in mm; None where that is not
        known. Another measurement with the same calibration has much of it in common, which cancels.
    alignment_rms_mm
        Distance left between the shapes; None where they were not laid on each other.
    """

    points: Floats
    difference: Floats
    sigma: Floats
    sigma_calibration: Floats | None
    alignment_rms_mm: float | None

    @property
    def valid(self) -> Mask:
        """Where there is a difference, (n,)."""
        return np.asarray(np.isfinite(self.difference).all(axis=1))

    def facts(self) -> dict[str, Any]:
        """Return what people ask for, with units in the names."""
        length = np.linalg.norm(self.difference[self.valid], axis=1)
        facts: dict[str, Any] = {
            "points": len(length),
            "of": len(self.points),
            "rms_mm": float(np.sqrt(np.mean(length**2))),
            "largest_mm": float(length.max()),
            "stated_sigma_mm": float(np.sqrt(np.mean(self.sigma[self.valid] ** 2))),
        }
        if self.sigma_calibration is not None:
            part = self.sigma_calibration[self.valid]
            facts["stated_sigma_calibration_mm"] = float(np.sqrt(np.mean(part**2)))
        if self.alignment_rms_mm is not None:
            facts["alignment_rms_mm"] = self.alignment_rms_mm
        for axis, values in zip(_AXES, self.difference[self.valid].T, strict=False):
            facts[f"mean_{axis}_mm"] = float(values.mean())
            facts[f"rms_{axis}_mm"] = float(np.sqrt(np.mean(values**2)))
        return facts

    def drawn(self, title: str) -> bytes:
        """Return maps of it as PNG."""
        return draw_difference(self.points, self.difference, title)

    def table(self) -> bytes:
        """Return points and differences as CSV, in mm."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        parts = [f"difference_{axis}_mm" for axis, _ in zip(_AXES, self.difference.T, strict=False)]
        writer.writerow([f"{axis}_mm" for axis in _AXES] + parts)
        writer.writerows(np.column_stack([self.points, self.difference]).round(7).tolist())
        return text.getvalue().encode()


@use_case(Right.READ)
def difference_of(services: Services, file: str, other: str, how: ComparisonOptions) -> Difference:
    """Subtract the displacement of a mesh file, or of another merged result, from a merged one.

    Parameters
    ----------
    file
        Number or archive path of a merged or combined result; of a camera alone, with a scale.
    other
        Number of another, or name of a mesh file.

    Raises
    ------
    InvalidInput
        They are no such files, or fewer than three points have anything of the other near.
    NotFound
        There is no such file.
    """
    # Many of those who load this module compare nothing.
    from sms_jobs.metrology.deformation.fields.comparison import free_of_motion, laid_on, values_at
    from sms_jobs.metrology.geometry.transforms import transform

    measured = _merged(services, file)
    mine, axes = measured.field, measured.axes
    if other.isdigit():
        theirs = _merged(services, other).field
    else:
        theirs = read_point_field(Path(other), how.field, how.scale_mm)
    residual: float | None = None
    if how.align:
        pose, residual = laid_on(theirs.points, mine.points)
        theirs = PointField(transform(pose, theirs.points), theirs.values @ pose.matrix().T)
    difference = mine.values - values_at(theirs.points, theirs.values, mine.points, how.within_mm)
    found = Difference(
        mine.points, difference[:, :axes], measured.sigma, measured.sigma_calibration, residual
    )
    met = np.count_nonzero(found.valid)
    if met < 3:
        raise InvalidInput(
            f"file {file} and {other} have {met} points within {how.within_mm:g} mm of each other; give "
            "their shapes one frame with `align`, their lengths one unit with `scale_mm`, or a larger "
            "`within_mm`"
        )
    if how.free:
        return replace(found, difference=free_of_motion(mine.points, difference)[:, :axes])
    return found


@dataclass(frozen=True)
class _Measured:
    """The displacement of a merged result at its vertices, its standard deviations, and number of axes."""

    field: PointField
    sigma: Floats
    sigma_calibration: Floats | None
    axes: int


def _merged(services: Services, key: str) -> _Measured:
    """Read a merged or combined result."""
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
    if view.source not in ("merge", "combine"):
        raise InvalidInput(
            f"file {key} ({view.source}) is no merged or combined result; choose one of a state"
        )
    with services.archive.open(view) as dataset:
        meshes = [one.read(dataset) for one in MESH.among(dataset.names)]
    in_mm = [mesh for mesh in meshes if mesh.unit == "mm"]
    if not in_mm:
        raise InvalidInput(
            f"the displacement of {view.subject} has no scale, and what it is compared with is in mm; give "
            "the size of a pixel as plane.mm_per_px and compute it again"
        )
    mesh = in_mm[0]
    axes = _AXES if mesh.has_depth else _AXES[:2]
    displacement = np.stack([mesh.value(name) for name in DISPLACEMENT_XYZ[: len(axes)]])
    points = in_space(mesh.vertices.T).T
    common = mesh.value(SIGMA_CALIBRATION) if SIGMA_CALIBRATION in mesh.value_names else None
    field = PointField(points, in_space(displacement).T)
    return _Measured(field, mesh.value(DISPLACEMENT_SIGMA), common, len(axes))
