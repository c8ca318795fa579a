"""Surfaces of CAD programs are read as they were written, and what is none is refused with a reason."""

from __future__ import annotations

import hashlib
import os
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


TEXT = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


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
        "only.ply": (b"ply", "no whole PLY"),
        "endless.ply": (b"ply\nformat ascii 1.0\nelement vertex 3\n", "no whole PLY"),
        "terabytes.ply": (TEXT.replace(b"vertex 3", b"vertex 10000000000000"), "cannot hold 10000000000000"),
        "short.ply": (TEXT.replace(b"vertex 3", b"vertex 9"), "no whole PLY"),
        "list.ply": (TEXT.replace(b"3 0 1 2", b"4000000000 0 1 2"), "no whole PLY"),
        "cut.ply": (TEXT.replace(b"ascii", b"binary_little_endian"), "no whole PLY"),
        "short.obj": (b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "line 1 is no vertex with three numbers"),
        "ragged.obj": (b"v 0 0 0\nv 1 0\nf 1 2 3\n", "line 2"),
        "zero.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "corners are missing"),
        "far.obj": (b"v 0 0 0\nv 1e9 0 0\nv 0 1 0\nf 1 2 3\n", "more than 10 km away"),
        "huge.obj": (b"v 0 0 0\nf 1 2 99999999999999999999\n", "corner 99999999999999999998"),
        "five.obj": (b"v 0 0 0\nf 1 1 1 1 1\n", "divide its faces into triangles"),
        "ragged.stl": (b"solid\nvertex 0 0 0\nvertex 1 2 3\n", "which are no triangles"),
        "part.step": (b"ISO-10303-21;", "save the part there as STL"),
        "part.png": (b"\x89PNG", "no surface that can be read"),
    }
    made = {}
    for name, (content, words) in contents.items():
        (folder / name).write_bytes(content)
        made[name] = (folder / name, words)
    return made


def test_other_programs_ply_and_faces_counted_backwards(tmp_path: Path) -> None:
    (tmp_path / "text.ply").write_bytes(TEXT)
    (tmp_path / "back.obj").write_bytes(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3/1/1 -2//2 -1\n")
    header = TEXT.replace(b"ascii", b"binary_big_endian").partition(b"0 0 0\n1")[0]
    numbers = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], ">f4").tobytes()
    (tmp_path / "big.ply").write_bytes(header + numbers + b"\3" + np.array([0, 1, 2], ">i4").tobytes())
    for name in ("text.ply", "back.obj", "big.ply"):
        np.testing.assert_array_equal(corners(tmp_path / name), [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])


def test_pipes_and_devices_are_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "zero.stl").symlink_to("/dev/zero")
    for name in ("pipe.ply", "zero.stl"):
        with pytest.raises(InvalidInput, match="no regular file"):
            read_reference_surface(tmp_path / name)


def test_what_is_no_surface_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name, (path, words) in damaged(tmp_path).items():
        with pytest.raises(InvalidInput, match=words) as refusal:
            read_reference_surface(path)
        assert name in str(refusal.value) or "reference surface" in str(refusal.value)
    with pytest.raises(InvalidInput, match="one of mm, cm, m, inch, um, not 'foot'"):
        read_reference_surface(tmp_path / "whole.stl", unit="foot")
    with pytest.raises(NotFound, match="there is no reference surface"):
        read_reference_surface(tmp_path / "none.stl")
    assert capfd.readouterr() == ("", "")  # nothing is said by the library that reads
