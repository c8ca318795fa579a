"""What is installed from a wheel is the same package, under the same names, as in a checkout."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def run(*command: str | Path, folder: Path, path: str = "") -> subprocess.CompletedProcess[str]:
    """Run Python in `folder`, with `path` as its PYTHONPATH."""
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip = ["-m", "pip", "--disable-pip-version-check", "wheel", "--quiet", "--no-deps"]
    built = run(*pip, "--no-build-isolation", "--wheel-dir", folder, ROOT, folder=folder)
    assert built.returncode == 0, built.stderr
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel's contents as pip lays them out; its dependencies are those of this environment."""
    folder = tmp_path_factory.mktemp("installed")
    pip = ["-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-deps", "--no-index"]
    done = run(*pip, "--target", folder, wheel, folder=folder)
    assert done.returncode == 0, done.stderr
    return folder


def contents(folder: Path) -> set[str]:
    """Return every file below a folder, as paths relative to it."""
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_the_wheel_holds_every_file_of_the_checkout(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for package in ("sms_jobs", "workers", "migrations"):
        inside = "sms_jobs" if package == "sms_jobs" else f"sms_jobs/{package}"
        missing = {f"{inside}/{name}" for name in contents(ROOT / package)} - names
        assert not missing


def test_the_wheel_installs_one_package_and_no_other_name(wheel: Path) -> None:
    top = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert {name for name in top if not name.endswith(".dist-info")} == {"sms_jobs"}


def test_the_installed_package_is_imported_from_where_it_lies(installed: Path, tmp_path: Path) -> None:
    program = (
        "import sms_jobs, sms_jobs.workers, sms_jobs.migrations\n"
        "print(sms_jobs.__file__, sms_jobs.workers.__file__, sms_jobs.migrations.__file__, sep='\\n')"
    )
    done = run("-c", program, folder=tmp_path, path=str(installed))
    assert done.returncode == 0, done.stderr
    for line in done.stdout.splitlines():
        assert Path(line).is_relative_to(installed)


@pytest.mark.parametrize("name", ["workers", "migrations"])
def test_a_folder_of_the_checkout_has_one_import_name(name: str) -> None:
    done = run("-c", f"import {name}", folder=ROOT)
    assert done.returncode == 1
    assert f"import sms_jobs.{name} instead" in done.stderr


@pytest.mark.long  # a minute; what is in the wheel is looked at in every run
def test_the_service_runs_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"

    def sms(*arguments: str | Path) -> str:
        command = ("-m", "sms_jobs.cli.main", *arguments)
        done = run(*command, folder=tmp_path, path=str(installed))
        assert done.returncode == 0, done.stderr
        return done.stdout

    (tmp_path / "plan.toml").write_text(sms("campaign", "create", "--example"))
    sms("init", "--home", home)
    sms("campaign", "create", "plan.toml", "--home", home)
    sms("job", "submit", "simulate", "-c", "plate-tension", "--state", "S00", "--home", home)
    sms("up", "--until-idle", "--home", home)
    assert json.loads(sms("status", "--json", "--home", home))["jobs"] == {"succeeded": 1}
