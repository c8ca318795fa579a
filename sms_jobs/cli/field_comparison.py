"""`sms data compare`: displacement against a calculation or against another measurement."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import typer
from numpy.typing import NDArray

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.cli import output, writing
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.other_fields import PointField, draw_difference, read_point_field
from sms_jobs.kinds.products import MESH
from sms_jobs.metrology.geometry.planes import in_space
from sms_jobs.records.fields import Mesh

Floats: TypeAlias = NDArray[np.float64]

_AXES = ("X", "Y", "Z")


def compare(
    file: Annotated[
        str, typer.Argument(help="Number or archive path of a merged or combined result of a state.")
    ],
    other: Annotated[
        str,
        typer.Option(
            "--with", help="Mesh file with a displacement at its nodes, or number of a merged result."
        ),
    ],
    field: Annotated[
        str | None, typer.Option(help="Displacement in the mesh file; the first with three components.")
    ] = None,
    scale_mm: Annotated[float, typer.Option(help="Length of the mesh file's unit in mm.", min=1e-9)] = 1.0,
    align: Annotated[
        bool, typer.Option("--align", help="First lay the other shape on this one: they have two frames.")
    ] = False,
    free: Annotated[
        bool, typer.Option("--free-of-motion", help="Leave out the rigid motion that they differ by.")
    ] = False,
    within_mm: Annotated[
        float, typer.Option(help="Points with nothing of the other within this are left out, mm.", min=0.0)
    ] = 5.0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write: .csv for numbers, .png for maps.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Subtract another displacement from a merged one: measured minus other, at the measured points.

    Example: sms data compare 42 --with panel.vtu --field U --scale-mm 1000 --free-of-motion --out diff.png
    """
    if out is not None:
        writing.check_new_file(out, force, (".csv", ".png"))
    how = How(field, scale_mm, align, free, within_mm)
    with bootstrap.services(home) as services:
        found = difference_of(services, file, other, how)
    facts = found.facts()
    for axis, values in zip(_AXES, found.difference[found.known].T, strict=False):
        facts[f"mean_{axis}_mm"] = float(values.mean())
        facts[f"rms_{axis}_mm"] = float(np.sqrt(np.mean(values**2)))
    if out is not None:
        content = _written(out, found.points, found.difference, f"file {file} minus {other}")
        writing.write_file(out, content, force)
        output.say(f"wrote {out}")
    if as_json:
        output.print_json({"file": file, "other": other} | facts)
        return
    output.print_facts({k.replace("_mm", " [mm]").replace("_", " "): _short(v) for k, v in facts.items()})


@dataclass(frozen=True)
class How:
    """How two displacements are compared: the options of the command, under their names."""

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
    alignment_rms_mm
        Distance left between the shapes; None where they were not laid on each other.
    """

    points: Floats
    difference: Floats
    sigma: Floats
    alignment_rms_mm: float | None

    @property
    def known(self) -> NDArray[np.bool_]:
        """Where there is a difference, (n,)."""
        return np.asarray(np.isfinite(self.difference).all(axis=1))

    def facts(self) -> dict[str, Any]:
        """Return what people ask for, with units in the names."""
        length = np.linalg.norm(self.difference[self.known], axis=1)
        facts: dict[str, Any] = {
            "points": len(length),
            "of": len(self.points),
            "rms_mm": float(np.sqrt(np.mean(length**2))),
            "largest_mm": float(length.max()),
            "stated_sigma_mm": float(np.sqrt(np.mean(self.sigma[self.known] ** 2))),
        }
        if self.alignment_rms_mm is not None:
            facts["alignment_rms_mm"] = self.alignment_rms_mm
        return facts


def difference_of(services: Services, file: str, other: str, how: How) -> Difference:
    """Subtract the displacement of a mesh file, or of another merged result, from a merged one.

    Raises `InvalidInput` where fewer than three points have anything of the other near.
    """
    # Other commands of this group load without what this one computes with.
    from sms_jobs.metrology.deformation.comparison import free_of_motion, laid_on, values_at
    from sms_jobs.metrology.geometry.transforms import transform

    mine, sigma, axes = _merged(services, file)
    if other.isdigit():
        theirs = _merged(services, other)[0]
    else:
        theirs = read_point_field(Path(other), how.field, how.scale_mm)
    residual: float | None = None
    if how.align:
        pose, residual = laid_on(theirs.points, mine.points)
        theirs = PointField(transform(pose, theirs.points), theirs.values @ pose.matrix().T)
    difference = mine.values - values_at(theirs.points, theirs.values, mine.points, how.within_mm)
    found = Difference(mine.points, difference[:, :axes], sigma, residual)
    met = np.count_nonzero(found.known)
    if met < 3:
        raise InvalidInput(
            f"file {file} and {other} have {met} points within {how.within_mm:g} mm of each other; give "
            "their shapes one frame with --align, their lengths one unit with --scale-mm, or a larger "
            "--within-mm"
        )
    if how.free:
        return replace(found, difference=free_of_motion(mine.points, difference)[:, :axes])
    return found


def _short(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def _written(out: Path, points: Floats, difference: Floats, title: str) -> bytes:
    if out.suffix == ".png":
        return draw_difference(points, difference, title)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    parts = [f"difference_{axis}_mm" for axis, _ in zip(_AXES, difference.T, strict=False)]
    writer.writerow([f"{axis}_mm" for axis in _AXES] + parts)
    writer.writerows(np.column_stack([points, difference]).round(7).tolist())
    return text.getvalue().encode()


def _merged(services: Services, key: str) -> tuple[PointField, Floats, int]:
    """Return the displacement of a merged result at its vertices, its standard deviation, and its axes."""
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
    if view.source not in ("merge", "combine"):
        raise InvalidInput(f"file {key} is a {view.source}; choose a merged or combined result of a state")
    with services.archive.open(view) as dataset:
        meshes = [dataset.read(one.stored_as, Mesh) for one in MESH.among(dataset.names)]
    in_mm = [mesh for mesh in meshes if mesh.unit == "mm"]
    if not in_mm:
        raise InvalidInput(
            f"the displacement of {view.subject} has no scale, and what it is compared with is in mm; give "
            "the size of a pixel as plane.mm_per_px and compute it again"
        )
    mesh = in_mm[0]
    axes = _AXES if mesh.has_depth else _AXES[:2]
    displacement = np.stack([mesh.value(f"displacement {axis}") for axis in axes])
    points = in_space(mesh.vertices.T).T
    return PointField(points, in_space(displacement).T), mesh.value("sigma of displacement"), len(axes)
