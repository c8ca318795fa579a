"""What the exporters write is read back by VTK, which shares no code with them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOGeometry import vtkOBJReader, vtkSTLReader, vtkTecplotReader
from vtkmodules.vtkIOPLY import vtkPLYReader
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.formats.exporters import all_exporters, exporter_named
from sms_jobs.formats.exporters.comma_separated import write_pixels
from sms_jobs.records.fields import Mesh, Surface

# Positions below are up to 300 mm and values up to 1: text has 9 digits, so half a unit of the ninth is
# 5e-7 mm and below 1e-9; STL, and the readers of OBJ, STL and PLY, keep 24 bits, 300 mm * 2^-24 = 1.8e-5 mm.
TEXT_MM = 5e-7
SINGLE_MM = 2e-5


@pytest.fixture
def mesh(rng: np.random.Generator) -> Mesh:
    """A bent sheet of 6 x 5 vertices; one value is missing somewhere."""
    x, y = np.meshgrid(np.linspace(-300.0, 300.0, 6), np.linspace(-200.0, 200.0, 5))
    vertices = np.column_stack([x.ravel(), y.ravel(), (50.0 * np.cos(x / 200.0)).ravel()])
    corner = np.arange(30).reshape(5, 6)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    values = rng.normal(size=(2, 30))
    values[1, 7] = np.nan
    return Mesh(("displacement Z", "strain, first"), ("mm", "1"), vertices, faces.astype(np.int32), values)


def written(name: str, mesh: Mesh, tmp_path: Path) -> Path:
    exporter = exporter_named(name)
    path = tmp_path / f"mesh{exporter.suffix}"
    exporter.write(mesh, path)
    return path


def read(reader: Any, path: Path) -> Any:
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


def points(grid: Any) -> Any:
    return vtk_to_numpy(grid.GetPoints().GetData())


def triangles(cells: Any) -> Any:
    return vtk_to_numpy(cells.GetConnectivityArray()).reshape(-1, 3)


def test_every_exporter_is_found_by_itself() -> None:
    names = ["csv", "e57", "matlab", "npz", "obj", "ply", "ptx", "stl", "tecplot", "tecplot-block"]
    assert list(all_exporters()) == [*names, "vtk", "vtu", "xyz"]
    assert len({e.suffix for e in all_exporters().values()}) == len(all_exporters())
    with pytest.raises(InvalidInput, match="choose one of csv, e57"):
        exporter_named("docx")


def test_tecplot(mesh: Mesh, tmp_path: Path) -> None:
    blocks = read(vtkTecplotReader(), written("tecplot", mesh, tmp_path))
    grid = blocks.GetBlock(0)
    np.testing.assert_allclose(points(grid), mesh.vertices, atol=SINGLE_MM)
    np.testing.assert_array_equal(triangles(grid.GetCells()), mesh.faces)
    data = grid.GetPointData()
    for name, values in zip(("displacement Z [mm]", "strain, first [1]"), mesh.values, strict=True):
        # The reader keeps single precision: values of a few units, 24 bits.
        np.testing.assert_allclose(vtk_to_numpy(data.GetArray(name)), values, atol=4 * 2.0**-24)


def test_tecplot_has_one_line_for_each_point(mesh: Mesh, tmp_path: Path) -> None:
    lines = written("tecplot", mesh, tmp_path).read_text().splitlines()
    assert lines[1] == 'VARIABLES = "X", "Y", "Z", "displacement Z [mm]", "strain, first [1]"'
    assert "N=30, E=40, DATAPACKING=POINT, ZONETYPE=FETRIANGLE" in lines[2]
    table = np.array([line.split() for line in lines[3:33]], float)
    np.testing.assert_allclose(table[:, :3], mesh.vertices, atol=TEXT_MM)
    np.testing.assert_allclose(table[:, 3:], mesh.values.T, rtol=5e-9)
    np.testing.assert_array_equal(np.array([line.split() for line in lines[33:]], int), mesh.faces + 1)


def test_stl(mesh: Mesh, tmp_path: Path) -> None:
    path = written("stl", mesh, tmp_path)
    surface = read(vtkSTLReader(), path)
    corners = points(surface)[triangles(surface.GetPolys())]
    np.testing.assert_allclose(corners, mesh.vertices[mesh.faces], atol=SINGLE_MM)
    facets = np.frombuffer(path.read_bytes()[84:], "<f4, <f4, <f4, 38V")
    normals = np.stack([facets[n] for n in ("f0", "f1", "f2")], -1)
    # The sheet is seen from +Z in the order of its corners, so its normals point there; float32 rounding.
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    assert normals[:, 2].min() > 0.5


def test_stl_of_a_triangle_without_area(mesh: Mesh, tmp_path: Path) -> None:
    flat = replace(mesh, faces=np.array([[0, 0, 1]], np.int32))
    assert written("stl", flat, tmp_path).stat().st_size == 84 + 50


def test_obj(mesh: Mesh, tmp_path: Path) -> None:
    surface = read(vtkOBJReader(), written("obj", mesh, tmp_path))
    np.testing.assert_allclose(points(surface), mesh.vertices, atol=SINGLE_MM)
    np.testing.assert_array_equal(triangles(surface.GetPolys()), mesh.faces)


def test_ply(mesh: Mesh, tmp_path: Path) -> None:
    path = written("ply", mesh, tmp_path)
    surface = read(vtkPLYReader(), path)
    np.testing.assert_allclose(points(surface), mesh.vertices, atol=SINGLE_MM)
    np.testing.assert_array_equal(triangles(surface.GetPolys()), mesh.faces)
    # VTK's reader drops scalars that it has no name for; the table behind the header is plain.
    header, _, body = path.read_bytes().partition(b"end_header\n")
    assert b"property double scalar_displacement_Z\nproperty double scalar_strain_first\n" in header
    table = np.frombuffer(body, "<f8", 30 * 5).reshape(30, 5)
    np.testing.assert_array_equal(table, np.column_stack([mesh.vertices, mesh.values.T]))


def test_vtu(mesh: Mesh, tmp_path: Path) -> None:
    grid = read(vtkXMLUnstructuredGridReader(), written("vtu", mesh, tmp_path))
    np.testing.assert_array_equal(points(grid), mesh.vertices)
    np.testing.assert_array_equal(triangles(grid.GetCells()), mesh.faces)
    data = grid.GetPointData()
    for name, values in zip(("displacement Z [mm]", "strain, first [1]"), mesh.values, strict=True):
        np.testing.assert_array_equal(vtk_to_numpy(data.GetArray(name)), values)


def test_csv(mesh: Mesh, tmp_path: Path) -> None:
    with written("csv", mesh, tmp_path).open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header == ["X [mm]", "Y [mm]", "Z [mm]", "displacement Z [mm]", "strain, first [1]"]
    np.testing.assert_allclose(np.array(rows, float)[:, :3], mesh.vertices, atol=TEXT_MM)


def test_csv_of_pixels_leaves_out_those_without_a_value(rng: np.random.Generator, tmp_path: Path) -> None:
    cloud = Surface(
        "C1P1",
        "mm",
        rng.normal(size=(3, 4, 5)),
        np.zeros((4, 5), np.uint32),
        rng.normal(size=(6, 4, 5)).astype(np.float32),
        rng.normal(size=(4, 5)).astype(np.float32),
    )
    for field in (cloud.position, cloud.covariance, cloud.ray_gap):
        field[..., 2, 3] = np.nan
    write_pixels(cloud, tmp_path / "pixels.csv")
    with (tmp_path / "pixels.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header[:5] == ["column [px]", "row [px]", "position X [mm]", "position Y [mm]", "position Z [mm]"]
    assert header[5] == "reason [bit]"
    assert header[-1] == "ray_gap [mm]"
    table = np.array(rows, float)
    assert len(table) == 4 * 5 - 1
    column, row = table[:, 0].astype(int), table[:, 1].astype(int)
    # 9 digits
    np.testing.assert_allclose(table[:, 4], cloud.position[2, row, column], rtol=5e-9)
    with pytest.raises(InvalidInput, match="no field over an image"):
        write_pixels(
            Mesh((), (), np.zeros((3, 3)), np.zeros((1, 3), np.int32), np.zeros((0, 3))), tmp_path / "a"
        )


OF_MESHES = [n for n, e in all_exporters().items() if Mesh in e.takes or object in e.takes]


@pytest.mark.parametrize("name", OF_MESHES)
def test_a_mesh_without_faces_is_not_exported(name: str, mesh: Mesh, tmp_path: Path) -> None:
    with pytest.raises(MeasurementFailed, match="no face"):
        written(name, replace(mesh, faces=np.zeros((0, 3), np.int32)), tmp_path)


@pytest.mark.parametrize("name", OF_MESHES)
def test_a_mesh_without_values_is_exported(name: str, mesh: Mesh, tmp_path: Path) -> None:
    bare = replace(mesh, value_names=(), value_units=(), values=np.zeros((0, 30)))
    assert written(name, bare, tmp_path).stat().st_size > 0
