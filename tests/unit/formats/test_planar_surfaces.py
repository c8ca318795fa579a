"""Displacement and strain in an image as flat surfaces, read back by programs that are not ours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.exporters import all_exporters, exporter_named
from sms_jobs.formats.exporters.exporter import PointGrid
from sms_jobs.formats.exporters.sources import source_for
from sms_jobs.formats.planar_surfaces import planar_grid, planar_mesh
from sms_jobs.records.planar import PlanarDisplacement, PlanarStrain
from sms_jobs.records.reasons import Reason

SCALE = 0.05
SHAPE = (12, 20)


def displacement(mm_per_px: float | None = None) -> PlanarDisplacement:
    """Return a stretch along the columns with a hole in it; image rows point down."""
    row, column = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float64)
    value = np.stack([0.01 * column, 0.5 + 0.02 * row])
    reason = np.zeros(SHAPE, np.uint32)
    reason[4:7, 8:12] = Reason.NO_MATCH
    value[:, reason != 0] = np.nan
    sigma = np.where(reason == 0, 0.01, np.nan).astype(np.float32)
    scaled = None if mm_per_px is None else value * mm_per_px
    return PlanarDisplacement("C1", "00", 10, mm_per_px, value, np.stack([sigma, 2 * sigma]), reason, scaled)


def strain(mm_per_px: float | None = None) -> PlanarStrain:
    reason = displacement().reason
    hole = np.where(reason == 0, 1.0, np.nan)
    values = np.stack([0.01 * hole, 0.02 * hole, 0.0 * hole])
    return PlanarStrain(
        "small", 8.0, mm_per_px, values, 1e-4 * values.astype(np.float32), values[:2], hole, reason
    )


@pytest.mark.parametrize("mm_per_px", [None, SCALE])
def test_a_flat_surface_moves_as_the_image_did(tmp_path: Path, mm_per_px: float | None) -> None:
    moved = displacement(mm_per_px)
    mesh = planar_mesh(planar_grid(moved, strain(mm_per_px)))
    path = tmp_path / "flat.vtu"
    exporter_named("vtu").write(mesh, path)
    read = meshio.read(path)
    scale, unit = (1.0, "px") if mm_per_px is None else (mm_per_px, "mm")
    data = {name: np.ravel(values) for name, values in read.point_data.items()}
    end = read.points[:, :2] + np.stack([data[f"displacement {a} [{unit}]"] for a in "XY"], axis=1)
    # Where a pixel has come to, in the image: x = column + u, and y up is minus (row + v).
    row, column = np.nonzero(moved.reason == 0)
    u, v = moved.displacement[:, row, column]
    np.testing.assert_allclose(end, scale * np.stack([column + u, -(row + v)], axis=1), atol=1e-12)
    np.testing.assert_allclose(data["strain yy [1]"], 0.02)
    # Seen by the camera all triangles turn one way: none is mirrored.
    a, b, c = (read.points[read.cells_dict["triangle"][:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()
    assert f"positions in {unit}" in path.read_bytes()[:200].decode()


@pytest.mark.parametrize("mm_per_px", [None, SCALE])
def test_every_format_takes_it_and_says_its_unit(tmp_path: Path, mm_per_px: float | None) -> None:
    grid = planar_grid(displacement(mm_per_px), strain(mm_per_px), np.full(SHAPE, 0.5))
    mesh = planar_mesh(grid)
    unit = "px" if mm_per_px is None else "mm"
    for name, exporter in all_exporters().items():
        path = tmp_path / f"flat-{name}{exporter.suffix}"
        source = grid if exporter.takes == (PointGrid,) else mesh
        if name == "e57" and mm_per_px is None:
            with pytest.raises(InvalidInput, match="E57 holds metres"):
                exporter.write(source, path)
            continue
        exporter.write(source, path)
        content = path.read_bytes()
        if name not in ("e57", "ptx", "matlab"):
            assert unit.encode() in content
            assert (b" mm" in content or b"[mm]" in content or b"_mm" in content) == (unit == "mm")


def test_one_record_alone_can_be_written_with_chosen_arrays(tmp_path: Path) -> None:
    moved = displacement()
    found = source_for(exporter_named("vtk"), moved, ["displacement"])
    assert found.value_names == ("displacement X", "displacement Y", "displacement")
    assert source_for(exporter_named("vtk"), strain(), ["sigma"]).value_names == tuple(
        f"sigma of strain {c}" for c in ("xx", "yy", "xy")
    )
    with pytest.raises(InvalidInput, match="no field 'xyz'"):
        source_for(exporter_named("vtk"), moved, ["xyz"])
    path = tmp_path / "pixels.csv"
    exporter_named("csv").write(source_for(exporter_named("csv"), moved), path)
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    assert len(table) == np.count_nonzero(moved.reason == 0)
    np.testing.assert_allclose(table[:, 2], 0.01 * table[:, 0], atol=1e-9)


def test_where_nothing_is_known_is_no_surface() -> None:
    moved = displacement()
    nothing = np.full_like(moved.displacement, np.nan)
    lost = replace(moved, displacement=nothing, reason=np.full(SHAPE, Reason.NO_MATCH, np.uint32))
    mesh = planar_mesh(planar_grid(lost, None))
    assert mesh.faces.shape == (0, 3)
