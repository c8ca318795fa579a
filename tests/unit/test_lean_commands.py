"""Commands load what they need and no more: told by the modules, not by a clock."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from support.homes import make_home

from sms_jobs.catalogue import schema
from sms_jobs.cli.commands import COMMANDS

KERNELS = {"cv2", "numba", "scipy", "matplotlib"}
CATALOGUE = {"sqlalchemy", "alembic", "h5py", "numpy"}
_SAY = (
    "import runpy, sys\n"
    "sys.argv[0] = 'sms'\n"
    "try:\n"
    "    runpy.run_module('sms_jobs.cli.main', run_name='__main__')\n"
    "except SystemExit as end:\n"
    "    assert not end.code, end.code\n"
    "print(*(name for name in sys.modules if '.' not in name), file=sys.stderr)\n"
)


def loaded(*words: str) -> set[str]:
    """Return the packages that a command has loaded at its end."""
    command = [sys.executable, "-c", _SAY, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, stdin=subprocess.DEVNULL)
    return set(done.stderr.splitlines()[-1].split())


@cache
def all_loaded() -> dict[str, str]:
    """Return what each command says of itself in one line."""
    return {name: command.load(name).get_short_help_str(300) for name, command in COMMANDS.items()}


@pytest.mark.parametrize("option", ["--version", "--help"])
def test_looking_around_needs_neither_catalogue_nor_kernels(option: str) -> None:
    assert not loaded(option) & (KERNELS | CATALOGUE)


@pytest.mark.parametrize(
    "words",
    ["status", "job list", "campaign list", "data tree 1", "data find calibration", "calibration list"],
)
def test_ordinary_commands_compute_nothing_and_migrate_nothing(words: str, home: Path) -> None:
    make_home(home, {})
    assert not loaded(*words.split(), "--home", str(home)) & (KERNELS | {"alembic"})


@pytest.mark.parametrize("name", COMMANDS)
def test_what_is_shown_of_a_command_is_what_it_says_itself(name: str) -> None:
    assert all_loaded()[name] == COMMANDS[name].help


def test_the_revisions_that_are_read_off_the_files_are_those_of_the_migrations() -> None:
    from alembic.script import ScriptDirectory

    scripts = ScriptDirectory.from_config(schema.configuration())
    assert [script.revision for script in scripts.walk_revisions()] == list(reversed(schema.revisions()))
