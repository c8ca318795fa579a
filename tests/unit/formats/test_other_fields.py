"""Results of calculations, read from files that meshio wrote."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.other_fields import draw_difference, read_point_field


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


def test_a_difference_is_drawn(rng: np.random.Generator) -> None:
    points, difference = rng.normal(size=(2, 50, 3))
    difference[3] = np.nan
    assert draw_difference(points, difference, "measured minus calculated").startswith(b"\x89PNG")
