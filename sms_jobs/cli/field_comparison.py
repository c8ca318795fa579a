"""`sms data compare`: displacement against a calculation or against another measurement."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.formats.other_fields import PointField, draw_difference, read_point_field
from sms_jobs.records.fields import Mesh

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
    # Other commands of this group load without what this one computes with.
    from sms_jobs.metrology.deformation.comparison import free_of_motion, laid_on, values_at
    from sms_jobs.metrology.geometry.transforms import transform

    if out is not None and out.suffix not in (".csv", ".png"):
        raise InvalidInput(f"'{out}' must end in .csv or .png")
    if out is not None and out.exists() and not force:
        raise Conflict(f"{out} exists; choose another name or add --force")
    with bootstrap.services(home) as services:
        mine, sigma = _merged(services, file)
        theirs = (
            _merged(services, other)[0] if other.isdigit() else read_point_field(Path(other), field, scale_mm)
        )
    residual: float | None = None
    if align:
        pose, residual = laid_on(theirs.points, mine.points)
        theirs = PointField(transform(pose, theirs.points), theirs.values @ pose.matrix().T)
    difference = mine.values - values_at(theirs.points, theirs.values, mine.points, within_mm)
    known = np.asarray(np.isfinite(difference).all(axis=1))
    if np.count_nonzero(known) < 3:
        raise InvalidInput(
            f"file {file} and {other} have {np.count_nonzero(known)} points within {within_mm:g} mm of each "
            "other; give their shapes one frame with --align, their lengths one unit with --scale-mm, or a "
            "larger --within-mm"
        )
    if free:
        difference = free_of_motion(mine.points, difference)
    length = np.linalg.norm(difference[known], axis=1)
    facts: dict[str, Any] = {
        "points": int(known.sum()),
        "of": len(mine.points),
        "rms_mm": float(np.sqrt(np.mean(length**2))),
        "largest_mm": float(length.max()),
        "stated_sigma_mm": float(np.sqrt(np.mean(sigma[known] ** 2))),
    }
    for axis, values in zip(_AXES, difference[known].T, strict=True):
        facts[f"mean_{axis}_mm"] = float(values.mean())
        facts[f"rms_{axis}_mm"] = float(np.sqrt(np.mean(values**2)))
    if residual is not None:
        facts["alignment_rms_mm"] = residual
    if out is not None:
        out.write_bytes(_written(out, mine.points, difference, f"file {file} minus {other}"))
        output.say(f"wrote {out}")
    if as_json:
        output.print_json({"file": file, "other": other} | facts)
        return
    output.print_facts({k.replace("_mm", " [mm]").replace("_", " "): _short(v) for k, v in facts.items()})


def _short(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def _written(out: Path, points: np.ndarray[Any, Any], difference: np.ndarray[Any, Any], title: str) -> bytes:
    if out.suffix == ".png":
        return draw_difference(points, difference, title)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([f"{axis}_mm" for axis in _AXES] + [f"difference_{axis}_mm" for axis in _AXES])
    writer.writerows(np.column_stack([points, difference]).round(7).tolist())
    return text.getvalue().encode()


def _merged(services: Services, key: str) -> tuple[PointField, np.ndarray[Any, Any]]:
    """Return the displacement of a merged result at its vertices, and its standard deviation."""
    with services.catalogue.reading() as session:
        view = search.file_view(session, key)
    if view.source not in ("merge", "combine"):
        raise InvalidInput(f"file {key} is a {view.source}; choose a merged or combined result of a state")
    with services.archive.open(view.path) as dataset:
        mesh = dataset.read("mesh", Mesh)
    values = dict(zip(mesh.value_names, mesh.values, strict=True))
    displacement = np.stack([values[f"displacement {axis}"] for axis in _AXES], axis=1)
    return PointField(mesh.vertices, displacement), values["sigma of displacement"]
