"""Surfaces of CAD programs are read as they were written, and what is none is refused with a reason."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.exporters import exporter_named
from sms_jobs.formats.reference_surfaces import read_reference_surface
from sms_jobs.records.fields import Mesh

CORNERS = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [10.0, 5.0, 1.0], [0.0, 5.0, 1.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
ASCII_STL = """solid part
facet normal 0 0 1
 outer loop
  vertex 0 0 0
  vertex 10 0 0
  vertex 10 5 1
 endloop
endfacet
endsolid part
"""


def corners(path: Path, **given: object) -> np.ndarray:
    found = read_reference_surface(path, **given)  # type: ignore[arg-type]
    return found.vertices[found.faces]


@pytest.mark.parametrize("name", ["stl", "ply", "obj"])
def test_what_we_write_is_read_again(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"part.{name}"
    exporter_named(name).write(Mesh((), (), CORNERS, FACES, np.zeros((0, 4))), path)
    found = read_reference_surface(path)
    # Whole numbers, which single precision and nine digits keep exactly.
    np.testing.assert_array_equal(found.vertices[found.faces], CORNERS[FACES])
    assert (found.filename, found.file_unit) == (path.name, "mm")
    assert found.file_sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    np.testing.assert_allclose(corners(path, unit="inch"), 25.4 * CORNERS[FACES], rtol=1e-15)
    np.testing.assert_array_equal(corners(path, turn_over=True), CORNERS[FACES][:, ::-1])


def test_text_stl_and_four_cornered_faces(tmp_path: Path) -> None:
    (tmp_path / "part.STL").write_text(ASCII_STL)
    np.testing.assert_array_equal(corners(tmp_path / "part.STL"), CORNERS[FACES[:1]])
    quad = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "f 1 2 3 4\n"
    (tmp_path / "quad.obj").write_text(quad)
    np.testing.assert_array_equal(corners(tmp_path / "quad.obj"), CORNERS[FACES])


def damaged(folder: Path) -> dict[str, tuple[Path, str]]:
    whole = folder / "whole.stl"
    exporter_named("stl").write(Mesh((), (), CORNERS, FACES, np.zeros((0, 4))), whole)
    contents = {
        "cut.stl": (whole.read_bytes()[:-30], "no whole STL"),
        "empty.stl": (b"", "no whole STL"),
        "empty.ply": (b"", "no whole PLY"),
        "empty.obj": (b"", "no triangle"),
        "noise.ply": (bytes(range(256)) * 4, "no whole PLY"),
        "points.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangle"),
        "beyond.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "corners are missing"),
        "flat.obj": (b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no triangle with an area"),
        "nan.obj": (b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "no finite position"),
        "words.obj": (b"v a b c\n", "no whole OBJ"),
        "part.step": (b"ISO-10303-21;", "save the part there as STL"),
        "part.png": (b"\x89PNG", "no surface that can be read"),
    }
    made = {}
    for name, (content, words) in contents.items():
        (folder / name).write_bytes(content)
        made[name] = (folder / name, words)
    return made


def test_what_is_no_surface_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name, (path, words) in damaged(tmp_path).items():
        with pytest.raises(InvalidInput, match=words) as refusal:
            read_reference_surface(path)
        assert name in str(refusal.value) or "reference surface" in str(refusal.value)
    with pytest.raises(InvalidInput, match="one of mm, cm, m, inch, um, not 'foot'"):
        read_reference_surface(tmp_path / "whole.stl", unit="foot")
    with pytest.raises(NotFound, match="there is no file"):
        read_reference_surface(tmp_path / "none.stl")
    assert capfd.readouterr() == ("", "")  # nothing is said by the library that reads
