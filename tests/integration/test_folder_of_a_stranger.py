"""Whoever works in a folder that somebody else has filled runs nothing that lies there.

Python looks for modules in the folder a program is started in, before its own, unless it is told not to.
"""

from __future__ import annotations

import ast
import json
from pathlib import Path

import meshio
import numpy as np
import pytest
from support.command import service, sms, wait_until
from support.homes import make_home

from sms_jobs.formats.foreign_meshes import read_node_fields

ROOT = Path(__file__).resolve().parents[2]
OURS = ["sms_jobs", "celeryconfig", "h5py", "json", "logging", "meshio", "numpy", "uvicorn"]
"""Names that the service, its workers, its page and those who read files import."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in a folder of traps: who runs one of its modules ends, and is noted in `ran` beside it."""
    folder = tmp_path / "stranger"
    folder.mkdir()
    for name in OURS:
        note = f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r})"
        (folder / f"{name}.py").write_text(f"{note}\nraise SystemExit('{name} of a stranger')\n")
    monkeypatch.chdir(folder)
    return tmp_path


def test_a_service_that_is_started_there_runs_what_is_installed(home: Path, folder: Path) -> None:
    make_home(home, {})
    with service(home, {"SMS_WORKERS": "1"}, "--web", "--listen", "127.0.0.1:0"):
        assert sms("job", "submit", "simulate", "-c", "plate", "--wait", "--home", str(home)).returncode == 0
        wait_until(lambda: "serving" in (home / "up.log").read_text())
    done = sms("archive", "verify", "--json", "--home", str(home))
    assert json.loads(done.stdout.splitlines()[-1])["findings"] == []
    assert not (folder / "ran").exists()


def test_a_mesh_is_read_there_by_the_program_that_is_installed(folder: Path) -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    mesh = meshio.Mesh(points, [("triangle", np.array([[0, 1, 2]]))], point_data={"u": 0.5 * points})
    meshio.write("mesh.vtk", mesh)
    nodes, fields = read_node_fields(Path("mesh.vtk"))
    np.testing.assert_array_equal(nodes, points)
    np.testing.assert_array_equal(fields["u"], 0.5 * points)
    assert not (folder / "ran").exists()


def test_every_process_of_python_is_told_not_to_look_there() -> None:
    said: dict[str, str] = {}
    for path in [*ROOT.glob("sms_jobs/**/*.py"), *ROOT.glob("workers/*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            words = node.elts if isinstance(node, ast.List) else []
            if words and ast.unparse(words[0]) == "sys.executable":
                said[f"{path.name}:{node.lineno}"] = ast.unparse(words[1])
    assert len(said) > 15
    assert {place: word for place, word in said.items() if word != "'-P'"} == {}
