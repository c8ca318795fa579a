"""Results of calculations, read from files that meshio wrote."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.other_fields import draw_difference, read_point_field, write_point_field
from sms_jobs.formats.state_differences import StateDifference, draw_states, written_table


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "xdmf"])
def test_a_displacement_at_nodes_comes_in_mm(tmp_path: Path, suffix: str, rng: np.random.Generator) -> None:
    points = rng.uniform(0.0, 0.3, (6, 3))
    moved = rng.normal(0.0, 1e-3, (6, 3))
    file = tmp_path / f"panel.{suffix}"
    mesh = meshio.Mesh(
        points, [("triangle", [[0, 1, 2], [3, 4, 5]])], point_data={"T": np.zeros(6), "U": moved}
    )
    mesh.write(file)
    found = read_point_field(file, None, 1000.0)
    np.testing.assert_allclose(found.points, 1000.0 * points, rtol=1e-6)
    np.testing.assert_allclose(found.values, 1000.0 * moved, rtol=1e-6)
    np.testing.assert_array_equal(read_point_field(file, "U", 1000.0).values, found.values)
    with pytest.raises(NotFound, match="those with three components are U"):
        read_point_field(file, "T", 1.0)


@pytest.mark.parametrize(
    ("names", "whole"),
    [
        (("displacement X [mm]", "displacement Y [mm]", "displacement Z [mm]"), "displacement [mm]"),
        (("U_x", "U_y", "U_z"), "U"),
        (("X", "Y", "Z"), "vector"),
    ],
)
def test_three_numbers_a_node_are_a_displacement(
    tmp_path: Path, rng: np.random.Generator, names: tuple[str, ...], whole: str
) -> None:
    """As our own exports have it, and those of others."""
    points, moved = rng.normal(size=(2, 3, 3))
    given = dict(zip(names, moved.T, strict=True)) | {"strain xx [1]": np.zeros(3), "Xtra": np.zeros(3)}
    meshio.Mesh(points, [("triangle", [[0, 1, 2]])], point_data=given).write(tmp_path / "panel.vtu")
    for name in (None, whole):
        np.testing.assert_array_equal(read_point_field(tmp_path / "panel.vtu", name, 1.0).values, moved)
    meshio.Mesh(points, [("triangle", [[0, 1, 2]])]).write(tmp_path / "bare.vtu")
    with pytest.raises(NotFound, match="no field with three components at its nodes, neither a vector nor"):
        read_point_field(tmp_path / "bare.vtu", None, 1.0)


def test_of_several_vectors_the_displacement_is_asked_for(tmp_path: Path, rng: np.random.Generator) -> None:
    points, moved = rng.normal(size=(2, 3, 3))
    fields = {"Normals": np.tile([0.0, 0.0, 1.0], (3, 1)), "U": moved}
    meshio.Mesh(points, [("triangle", [[0, 1, 2]])], point_data=fields).write(tmp_path / "panel.vtu")
    with pytest.raises(InvalidInput, match=r"has the fields Normals, U .*: say which"):
        read_point_field(tmp_path / "panel.vtu", None, 1.0)
    np.testing.assert_array_equal(read_point_field(tmp_path / "panel.vtu", "U", 1.0).values, moved)


def test_what_is_no_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="there is no file"):
        read_point_field(tmp_path / "nothing.vtu", None, 1.0)
    wrong = tmp_path / "wrong.vtu"
    wrong.write_text("no mesh at all", encoding="utf-8")
    with pytest.raises(InvalidInput, match="cannot be read as a mesh"):
        read_point_field(wrong, None, 1.0)
    (tmp_path / "panel.odd").write_text("x", encoding="utf-8")
    with pytest.raises(InvalidInput, match="cannot be read as a mesh"):
        read_point_field(tmp_path / "panel.odd", None, 1.0)
    sheet = tmp_path / "sheet.vtk"
    lines = ["# vtk DataFile Version 3.0", "a sheet", "ASCII", "DATASET POLYDATA", "POINTS 3 float"]
    sheet.write_text("\n".join([*lines, "0 0 0 1 0 0 0 1 0", "POLYGONS 1 4", "3 0 1 2"]), encoding="utf-8")
    with pytest.raises(
        InvalidInput, match=r"not POLYDATA.*save it as VTU, .* unstructured grid of legacy VTK"
    ):
        read_point_field(sheet, None, 1.0)


def test_a_difference_is_drawn(rng: np.random.Generator) -> None:
    points, difference = rng.normal(size=(2, 50, 3))
    difference[3] = np.nan
    assert draw_difference(points, difference, "measured minus calculated").startswith(b"\x89PNG")


def test_what_is_written_is_read_again(tmp_path: Path, rng: np.random.Generator) -> None:
    nodes, moved = rng.normal(size=(2, 4, 3))
    write_point_field(tmp_path / "S01.vtu", nodes, np.array([[0, 1, 2], [1, 2, 3]], np.int32), moved)
    found = read_point_field(tmp_path / "S01.vtu", "displacement", 1.0)
    np.testing.assert_array_equal(found.points, nodes)
    np.testing.assert_array_equal(found.values, moved)


def test_the_rms_is_told_over_all_states(rng: np.random.Generator) -> None:
    length = np.r_[np.full(95, 0.01), np.full(5, 0.2)]
    states = [
        StateDifference(f"S0{k}", load, 0.5 * k, rng.normal(size=(100, 3)), k * length, 0.008)
        for k, load in ((1, 1000.0), (2, None))
    ]
    first, second = states
    assert first.rms_mm == pytest.approx(np.sqrt((95 * 0.01**2 + 5 * 0.2**2) / 100))
    assert first.good_rms_mm == pytest.approx(0.01)
    assert second.rms_mm == pytest.approx(2.0 * first.rms_mm)
    named = second.named()
    assert (named["state"], named["load_n"], named["points"]) == ("S02", None, 100.0)
    header, *rows = written_table(states).decode().splitlines()
    assert header.startswith("state,load_n,applied_mm,points,rms_mm")
    assert [row.split(",")[:2] for row in rows] == [["S01", "1000.0"], ["S02", ""]]
    assert draw_states(states, "measured minus calculated").startswith(b"\x89PNG")
