"""Points, arrays and colours in the files of other programs, read back by readers that are not ours."""

from __future__ import annotations

import csv
import re
import struct
import tracemalloc
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.io import loadmat
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOGeometry import vtkTecplotReader
from vtkmodules.vtkIOLegacy import vtkPolyDataReader

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.formats.exporters import all_exporters, comma_separated, exporter_named
from sms_jobs.formats.exporters.exporter import PointGrid
from sms_jobs.formats.exporters.sources import mesh_of, source_for, value_fields
from sms_jobs.records.cracks import CrackOpenings
from sms_jobs.records.fields import DisplacementField, Mesh, Region, Surface
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.system_test import SystemTest

ROWS, COLUMNS = 9, 13
# Nine digits of positions up to 300 mm: half a unit of the ninth is 5e-7 mm.
TEXT_MM = 5e-7


@pytest.fixture
def cloud(rng: np.random.Generator) -> Surface:
    """A bent sheet of 9 x 13 pixels with a hole of two."""
    y, x = np.mgrid[0:ROWS, 0:COLUMNS].astype(float)
    xyz = np.stack([20.0 * x - 120.0, 20.0 * y, 30.0 * np.cos(x / 6.0)])
    covariance = np.abs(rng.normal(1e-4, 1e-5, (6, ROWS, COLUMNS))).astype(np.float32)
    gap = rng.normal(size=(ROWS, COLUMNS)).astype(np.float32)
    reason = np.zeros((ROWS, COLUMNS), np.uint32)
    reason[4, 5:7] = 1
    for field in (xyz, covariance, gap):
        field[..., 4, 5:7] = np.nan
    return Surface("C1P1", "mm", xyz, reason, covariance, gap)


@pytest.fixture
def texture(rng: np.random.Generator) -> Any:
    return rng.random((ROWS, COLUMNS))


def written(name: str, record: Any, tmp_path: Path, **given: Any) -> Path:
    exporter = exporter_named(name)
    path = tmp_path / f"result{exporter.suffix}"
    exporter.write(source_for(exporter, record, **given), path)
    return path


def seen(cloud: Surface) -> Any:
    return np.isfinite(cloud.position).all(axis=0)


def test_xyz_has_every_point_with_a_position(cloud: Surface, tmp_path: Path) -> None:
    path = written("xyz", cloud, tmp_path)
    table = np.loadtxt(path, comments="//")
    known = seen(cloud)
    assert len(table) == ROWS * COLUMNS - 2
    np.testing.assert_allclose(table[:, :3], cloud.position[:, known].T, atol=TEXT_MM)
    names = path.read_text().splitlines()[0].split()
    assert names[:4] == ["//", "X_[mm]", "Y_[mm]", "Z_[mm]"]
    np.testing.assert_allclose(table[:, names.index("ray_gap_[mm]") - 1], cloud.ray_gap[known], rtol=5e-9)


def test_ptx_is_the_grid_with_grey(cloud: Surface, texture: Any, tmp_path: Path) -> None:
    lines = written("ptx", cloud, tmp_path, texture=texture).read_text().splitlines()
    assert (int(lines[0]), int(lines[1])) == (COLUMNS, ROWS)
    np.testing.assert_array_equal(np.loadtxt(lines[3:6]), np.eye(3))
    np.testing.assert_array_equal(np.loadtxt(lines[6:10]), np.eye(4))
    # Column by column, each from below.
    table = np.loadtxt(lines[10:]).reshape(COLUMNS, ROWS, 4)[:, ::-1].transpose(2, 1, 0)
    known = seen(cloud)
    np.testing.assert_allclose(table[:3, known], cloud.position[:, known], atol=TEXT_MM)
    np.testing.assert_allclose(table[3, known], texture[known], atol=5e-5)  # four digits
    assert not table[:, ~known].any()


def checksum(page: bytes) -> int:
    """CRC-32C bit by bit, as its definition has it."""
    crc = 0xFFFFFFFF
    for byte in page:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def test_e57_is_built_as_the_standard_says(cloud: Surface, texture: Any, tmp_path: Path) -> None:
    assert checksum(b"123456789") == 0xE3069283  # the check value of CRC-32C
    raw = written("e57", cloud, tmp_path, texture=texture).read_bytes()
    pages = [raw[i : i + 1024] for i in range(0, len(raw), 1024)]
    assert all(checksum(p[:1020]) == int.from_bytes(p[1020:], "big") for p in pages)
    logical = b"".join(p[:1020] for p in pages)
    magic, major, minor, size, xml_at, xml_size, page = struct.unpack_from("<8sIIQQQQ", logical)
    assert (magic, major, minor, size, page) == (b"ASTM-E57", 1, 0, len(raw), 1024)
    start = xml_at // 1024 * 1020 + xml_at % 1024
    root = ET.fromstring(logical[start : start + xml_size])
    points = root.find(".//{*}points")
    assert points is not None
    known = seen(cloud)
    count = int(points.attrib["recordCount"])
    assert count == np.count_nonzero(known)
    packet = 48 + 32
    kind, _, length, streams = struct.unpack_from("<BBHH", logical, packet)
    assert (kind, (length + 1) % 4, streams) == (1, 0, 6)
    xyz = np.frombuffer(logical, "<f8", 3 * count, packet + 6 + 12).reshape(3, count)
    # The standard wants metres; a double is rounded twice on the way, 300 mm * 2^-52.
    np.testing.assert_allclose(xyz * 1e3, cloud.position[:, known], rtol=1e-15, atol=1e-13)


def test_e57_is_read_by_another_library(cloud: Surface, texture: Any, tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed")
    large = replace(
        cloud,
        position=np.tile(cloud.position, (1, 20, 10)),  # several packets
        covariance=np.tile(cloud.covariance, (1, 20, 10)),
        ray_gap=np.tile(cloud.ray_gap, (20, 10)),
        reason=np.tile(cloud.reason, (20, 10)),
    )
    grey = np.tile(texture, (20, 10))
    file = pye57.E57(str(written("e57", large, tmp_path, texture=grey)))
    found = file.read_scan_raw(0)
    file.close()
    known = seen(large)
    for axis, expected in zip("XYZ", large.position[:, known], strict=True):
        np.testing.assert_allclose(found[f"cartesian{axis}"] * 1e3, expected, rtol=1e-15, atol=1e-13)
    np.testing.assert_array_equal(found["rowIndex"], np.nonzero(known)[0])
    np.testing.assert_array_equal(found["columnIndex"], np.nonzero(known)[1])
    np.testing.assert_allclose(found["intensity"], grey[known], rtol=2.0**-24)  # single precision


def test_npz_keeps_every_bit_and_says_the_units(cloud: Surface, tmp_path: Path) -> None:
    with np.load(written("npz", cloud, tmp_path), allow_pickle=False) as found:
        np.testing.assert_array_equal(found["position_mm"], cloud.position)
        np.testing.assert_array_equal(found["covariance_mm2"], cloud.covariance)
        np.testing.assert_array_equal(found["reason"], cloud.reason)
        units = dict(zip(found["names"], found["units"], strict=True))
    assert units == {"position_mm": "mm", "covariance_mm2": "mm^2", "ray_gap_mm": "mm", "reason": "bit"}


def test_matlab_has_images_first_and_counts_from_one(cloud: Surface, tmp_path: Path) -> None:
    path = written("matlab", cloud, tmp_path)
    found = loadmat(path, simplify_cells=True)
    np.testing.assert_array_equal(np.moveaxis(found["position_mm"], 2, 0), cloud.position)
    assert found["units"]["covariance_mm2"] == "mm^2"
    assert found["meanings"]["position_mm"] == "position"
    mesh = source_for(exporter_named("ply"), cloud)
    found = loadmat(written("matlab", mesh, tmp_path), simplify_cells=True)
    np.testing.assert_array_equal(found["faces"], mesh.faces + 1)
    np.testing.assert_array_equal(found["ray_gap_mm"], mesh.values[mesh.value_names.index("ray_gap")])


@pytest.mark.parametrize("name", list(all_exporters()))
def test_the_same_result_makes_the_same_file(name: str, cloud: Surface, texture: Any, tmp_path: Path) -> None:
    first = written(name, cloud, tmp_path, texture=texture).read_bytes()
    assert written(name, cloud, tmp_path, texture=texture).read_bytes() == first


def test_tecplot_packed_by_variable(cloud: Surface, tmp_path: Path) -> None:
    mesh = source_for(exporter_named("tecplot"), cloud)
    path = written("tecplot-block", mesh, tmp_path)
    lines = path.read_text().splitlines()
    assert "DATAPACKING=BLOCK, ZONETYPE=FETRIANGLE" in lines[2]
    assert max(map(len, lines[3:])) < 200
    reader = vtkTecplotReader()
    reader.SetFileName(str(path))
    reader.Update()
    grid = reader.GetOutput().GetBlock(0)
    # The reader keeps 24 bits of up to 300 mm.
    np.testing.assert_allclose(vtk_to_numpy(grid.GetPoints().GetData()), mesh.vertices, atol=2e-5)
    numbers = np.array(" ".join(lines[3 : -len(mesh.faces)]).split(), float)
    columns = numbers.reshape(3 + len(mesh.values), len(mesh.vertices))
    np.testing.assert_allclose(columns[:3], mesh.vertices.T, atol=TEXT_MM)
    np.testing.assert_allclose(columns[3:], mesh.values, rtol=5e-9)


def test_vtk_legacy(cloud: Surface, tmp_path: Path) -> None:
    mesh = source_for(exporter_named("vtk"), cloud)
    reader = vtkPolyDataReader()
    reader.SetFileName(str(written("vtk", mesh, tmp_path)))
    reader.Update()
    found = reader.GetOutput()
    np.testing.assert_array_equal(vtk_to_numpy(found.GetPoints().GetData()), mesh.vertices)
    corners = vtk_to_numpy(found.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    np.testing.assert_array_equal(corners, mesh.faces)
    values = vtk_to_numpy(found.GetPointData().GetArray("covariance XX [mm^2]"))
    np.testing.assert_array_equal(values, mesh.values[mesh.value_names.index("covariance XX")])


def test_obj_and_ply_show_the_texture_as_grey(cloud: Surface, texture: Any, tmp_path: Path) -> None:
    texture[0, 0] = np.nan
    mesh = source_for(exporter_named("obj"), cloud, texture=texture)
    expected = np.nan_to_num(mesh.values[mesh.value_names.index("texture")], nan=0.0)
    lines = written("obj", mesh, tmp_path).read_text().splitlines()
    vertices = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    np.testing.assert_allclose(vertices[:, :3], mesh.vertices, atol=TEXT_MM)
    for grey in vertices[:, 3:].T:
        np.testing.assert_allclose(grey, expected, atol=5e-5)  # four digits
    read = meshio.read(written("ply", mesh, tmp_path))
    np.testing.assert_array_equal(read.points, mesh.vertices)
    np.testing.assert_array_equal(read.cells_dict["triangle"], mesh.faces)
    np.testing.assert_array_equal(read.point_data["scalar_ray_gap"], mesh.value("ray_gap"))
    for colour in ("red", "green", "blue"):
        np.testing.assert_array_equal(read.point_data[colour].astype(np.uint8), np.rint(255 * expected))


def test_csv_says_how_a_value_is_computed(cloud: Surface, tmp_path: Path) -> None:
    mesh = replace(
        source_for(exporter_named("csv"), mesh_of_cloud(cloud), chosen=["ray_gap"]),
        value_names=("displacement",),
    )
    header = written("csv", mesh, tmp_path).read_text().splitlines()[0]
    assert header == '"X [mm]","Y [mm]","Z [mm]","displacement [mm]: sqrt(X^2 + Y^2 + Z^2)"'


def mesh_of_cloud(cloud: Surface) -> Mesh:
    mesh = source_for(exporter_named("ply"), cloud)
    assert isinstance(mesh, Mesh)
    return mesh


def test_the_mesh_of_a_cloud_has_no_triangle_over_a_step_or_a_hole(cloud: Surface) -> None:
    cloud.position[2, :, 8:] += 200.0  # ten pixels high
    mesh = mesh_of_cloud(cloud)
    corners = mesh.vertices[mesh.faces]
    heights = np.ptp(corners[:, :, 2], axis=1)
    # The sheet falls by 30 / 6 mm in a column at most.
    assert heights.max() < 6.0
    assert len(mesh.vertices) == ROWS * COLUMNS - 2
    # A square of 9 x 8 pixels and one of 9 x 5; a hole of two neighbours takes 8 to 10 triangles.
    assert 2 * (8 * 7 + 8 * 4) - 10 <= len(mesh.faces) <= 2 * (8 * 7 + 8 * 4) - 8


def test_vertices_without_a_position_take_their_triangles_along(cloud: Surface, tmp_path: Path) -> None:
    mesh = mesh_of_cloud(cloud)
    lost = mesh.faces[0, 0]
    mesh.vertices[lost] = np.nan
    read = meshio.read(written("stl", mesh, tmp_path))
    left = (mesh.faces != lost).all(axis=1)
    assert np.isfinite(read.points).all()
    assert len(read.cells_dict["triangle"]) == np.count_nonzero(left)
    with pytest.raises(MeasurementFailed, match="no face"):
        written("obj", replace(mesh, vertices=np.full_like(mesh.vertices, np.nan)), tmp_path)
    nowhere = replace(cloud, position=np.full_like(cloud.position, np.nan))
    with pytest.raises(MeasurementFailed, match="no point with a position"):
        written("ptx", nowhere, tmp_path)


def test_fields_are_chosen_by_name(cloud: Surface, tmp_path: Path) -> None:
    assert value_fields(cloud) == ["position", "reason", "covariance", "ray_gap"]
    mesh = source_for(exporter_named("vtu"), cloud, ["ray_gap"])
    assert (mesh.value_names, mesh.value_units) == (("ray_gap",), ("mm",))
    with np.load(written("npz", cloud, tmp_path, chosen=["position"])) as found:
        assert list(found["names"]) == ["position_mm"]
    with pytest.raises(
        InvalidInput, match=re.escape("no field 'strain'; choose among position, reason, covariance")
    ):
        source_for(exporter_named("csv"), cloud, ["strain"])


def test_what_a_format_cannot_hold_is_refused_with_a_way_out(cloud: Surface) -> None:
    zeros = np.zeros((6, 4, 4), np.float32)
    moved = DisplacementField(
        "C1P1",
        "S00",
        "mm",
        zeros[:3].astype(float),
        zeros,
        zeros[:2].astype(float),
        zeros[0].astype(np.uint32),
    )
    with pytest.raises(InvalidInput, match="DisplacementField has no positions, which ply needs"):
        source_for(exporter_named("ply"), moved)
    with pytest.raises(InvalidInput, match="ptx takes points in the order of an image"):
        source_for(exporter_named("ptx"), mesh_of_cloud(cloud))


STREAMED = ["e57", "ply", "ptx", "stl", "tecplot", "vtk", "vtu"]
"""The other formats of text are written by what writes Tecplot's."""


@pytest.mark.parametrize("name", STREAMED)
def test_memory_stays_bounded_while_a_file_is_written(name: str, tmp_path: Path) -> None:
    size, values = 150, 20
    y, x = np.mgrid[0:size, 0:size].astype(float)
    names = tuple(f"v{i}" for i in range(values))
    grid = PointGrid(np.stack([x, y, 0.0 * x]), names, ("mm",) * values, np.stack([x] * values))
    exporter = exporter_named(name)
    source = grid if PointGrid in exporter.takes else mesh_of(grid)
    tracemalloc.start()
    exporter.write(source, tmp_path / "large")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # 23 numbers of each of 22,500 points are 4.1 MB. Of text, 20,000 numbers are made at once, of about
    # 60 bytes as Python has them; of bytes, 5,000 points, which are 0.9 MB; E57 collects the positions, 1 MB.
    assert peak < 3e6


def test_points_of_a_record_are_lines_of_numbers(tmp_path: Path) -> None:
    path, points = tmp_path / "cracks.csv", np.arange(3.0)
    some = np.ones(3, np.int32)
    sigma = np.full(3, 0.5, np.float32)
    place = np.stack([points, 10.0 + points], axis=1)
    record = CrackOpenings(
        "C1",
        "S00",
        "px",
        some,
        some,
        2 * some,
        place,
        -place,
        points,
        0.1 * points,
        sigma,
        0.2 * points,
        sigma,
    )
    comma_separated.write(record, path)
    head, *lines = path.read_text().splitlines()
    assert head.startswith(
        '"crack [1]","right [1]","left [1]","pixel column [px]","pixel row [px]","position X [px]"'
    )
    assert [float(value) for value in lines[2].split(",")] == pytest.approx(
        [1, 1, 2, 2, 12, -2, -12, 2, 0.2, 0.5, 0.4, 0.5]
    )


def readings(*names: str) -> GaugeReadings:
    count = len(names)
    strain, place = 1e-3 * np.arange(1.0, count + 1), np.zeros((count, 3))
    return GaugeReadings("small", names, strain, np.ones(count, np.float32), place, np.ones(count, np.int32))


def test_rows_of_gauges_have_their_names(tmp_path: Path) -> None:
    record = readings("G1", 'rib "a", left', "Steg Süd")
    comma_separated.write(record, tmp_path / "g.csv")
    with (tmp_path / "g.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["gauge"], float(row["strain [1]"])) for row in rows] == [
        ("G1", 1e-3),
        ('rib "a", left', 2e-3),
        ("Steg Süd", 3e-3),
    ]
    exporter_named("npz").write(record, tmp_path / "g.npz")
    with np.load(tmp_path / "g.npz") as arrays:
        assert arrays["gauge"].tolist() == list(record.names)
    exporter_named("matlab").write(record, tmp_path / "g.mat")
    assert [str(cell[0]) for cell in loadmat(tmp_path / "g.mat")["gauge"][:, 0]] == list(record.names)
    comma_separated.write(readings(), tmp_path / "none.csv")
    assert len((tmp_path / "none.csv").read_text().splitlines()) == 1


def test_rows_of_a_system_test_say_what_was_tested(tmp_path: Path) -> None:
    one = np.ones(2)
    record = SystemTest(
        "ball bar",
        "2026-1",
        ("probing-form", "length"),
        ("S00", "S01"),
        ("C1P1", "C1P1"),
        ("", "one sphere is not seen"),
        one,
        one,
        one,
        np.ones(2, np.int64),
        np.ones(2, np.int64),
    )
    comma_separated.write(record, tmp_path / "t.csv")
    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert lines[0].startswith('"quantity","state","view","missing","error [mm]"')
    assert lines[2].startswith('"length","S01","C1P1","one sphere is not seen",1,')


def test_a_record_without_values_in_rows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="no values over an image or at points"):
        comma_separated.write(Region(1, 2, (0.0, 0.0)), tmp_path / "x.csv")
