"""Wrong input gets one sentence and its exit code, and leaves nothing behind."""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import h5py
import pytest
from support.command import answer, inside
from support.homes import make_home

FOLDER = Path(__file__).parent / "wrong_inputs"

USAGE, NOT_FOUND, CONFLICT, CORRUPT, FAILED = 2, 3, 4, 6, 5


def contents(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder but locks; the write-ahead log of SQLite may come and go."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.endswith(("-wal", "-shm", ".lock"))
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with the campaign `plate`, made once; tests that damage it work on a copy."""
    home = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("SMS_HOME", raising=False)
        make_home(home, {})
    return home


def refused(made: Path, code: int, *arguments: str, words: tuple[str, ...]) -> None:
    """Run a command that must be refused in one sentence, with nothing changed."""
    before = contents(made)
    done = inside(*arguments, "--home", str(made))
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert len([line for line in done.stderr.strip().splitlines() if line.startswith("error:")]) <= 1
    for word in words:
        assert word in " ".join(done.stderr.split())
    assert contents(made) == before


@dataclass(frozen=True)
class Plan:
    """A test plan that cannot be used, and what its refusal has to name."""

    file: str
    words: tuple[str, ...]


@pytest.mark.parametrize(
    "plan",
    [
        Plan("text_for_a_number.toml", ("text_for_a_number.toml", "fx", "number")),
        Plan("unknown_key.toml", ("unknown_key.toml", "exposure_ms")),
        Plan("not_toml.toml", ("not_toml.toml", "TOML")),
        Plan("two_states_of_one_label.toml", ("two_states_of_one_label.toml", "S01")),
        Plan("too_few_steps.toml", ("too_few_steps.toml", "3")),
        Plan("name_that_leaves_the_archive.toml", ("name_that_leaves_the_archive.toml", "../wing")),
        Plan("no_such_pair.toml", ("no_such_pair.toml", "no sensor P9")),
        Plan("binary.toml", ("binary.toml",)),
        Plan("parameter_that_no_kind_takes.toml", ("gauge_length_in", "gauge_length_mm")),
        Plan("kind_that_does_not_exist.toml", ("paint", "strain")),
    ],
    ids=lambda plan: plan.file,
)
def test_a_plan_that_cannot_be_used(made: Path, plan: Plan) -> None:
    refused(made, USAGE, "campaign", "create", str(FOLDER / plan.file), words=plan.words)


@pytest.mark.parametrize(
    ("code", "arguments", "words"),
    [
        (NOT_FOUND, ["campaign", "show", "wing"], ["wing", "plate"]),
        (NOT_FOUND, ["job", "submit", "pipeline", "-c", "wing"], ["wing", "plate"]),
        (NOT_FOUND, ["job", "show", "ffff"], ["ffff", "sms job list"]),
        (NOT_FOUND, ["job", "submit", "strain", "-c", "plate"], ["correlate", "plate/S01"]),
        (NOT_FOUND, ["data", "show", "999"], ["999"]),
        (NOT_FOUND, ["calibration", "show", "9"], ["9"]),
        (USAGE, ["calibration", "show", "nine"], ["number"]),
        (USAGE, ["job", "submit", "paint", "-c", "plate"], ["paint", "reconstruct"]),
        (USAGE, ["job", "submit", "simulate", "-c", "plate", "--state", "S77"], ["S77", "S00"]),
        (USAGE, ["job", "submit", "simulate", "-c", "plate", "--set", "colour=red"], ["colour"]),
        (USAGE, ["job", "submit", "simulate", "-c", "plate", "--set", "colour"], ["NAME=VALUE"]),
        (USAGE, ["job", "submit", "pipeline", "-c", "plate", "--set", "gauge=3"], ["gauge", "KIND.NAME"]),
        (
            USAGE,
            ["job", "submit", "pipeline", "-c", "plate", "--set", "strain.gauge_length_mm=long"],
            ["gauge_length_mm", "long"],
        ),
        (USAGE, ["job", "list", "--state", "asleep"], ["asleep"]),
        (USAGE, ["job", "list", "--limit", "many"], ["--limit"]),
        (NOT_FOUND, ["campaign", "create", "missing.toml"], ["missing.toml"]),
        (USAGE, ["campaign", "create"], ["--example"]),
        (USAGE, ["job", "cancel"], ["--campaign"]),
        (NOT_FOUND, ["job", "retry", "ffff"], ["ffff"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else str(value),
)
def test_a_command_that_cannot_be_done(made: Path, code: int, arguments: list[str], words: list[str]) -> None:
    refused(made, code, *arguments, words=tuple(words))


def test_two_campaigns_of_one_name(made: Path, tmp_path: Path) -> None:
    home = shutil.copytree(made, tmp_path / "home")
    plan = tmp_path / "plan.toml"
    plan.write_text(inside("campaign", "create", "--example").stdout)
    name = answer("campaign", "create", str(plan), "--home", str(home))["campaign"]
    refused(home, CONFLICT, "campaign", "create", str(plan), words=(name, "already"))
    assert len(answer("calibration", "list", "--home", str(home))) == 2


def test_a_home_that_is_not_there(tmp_path: Path) -> None:
    for command in (["status"], ["campaign", "list"], ["up"], ["job", "list"], ["db", "upgrade"]):
        done = inside(*command, "--home", str(tmp_path / "nowhere"))
        assert done.returncode == USAGE
        assert "sms init" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_home_that_cannot_be_written(tmp_path: Path) -> None:
    # Below a file no folder can be made, not even by root.
    (tmp_path / "file").touch()
    for command in (["init", "--home"], ["demo", "--out"]):
        done = inside(*command, str(tmp_path / "file" / "home"))
        assert done.returncode == USAGE
        assert "cannot be made" in done.stderr
        assert "Traceback" not in done.stderr


def test_a_catalogue_of_a_newer_version(made: Path, tmp_path: Path) -> None:
    home = shutil.copytree(made, tmp_path / "home")
    with sqlite3.connect(home / "catalogue.sqlite") as database:
        database.execute("UPDATE alembic_version SET version_num = '9999'")
    database.close()
    refused(home, CONFLICT, "status", words=("9999", "newer"))


def test_a_setting_that_cannot_be_used(made: Path, tmp_path: Path) -> None:
    home = shutil.copytree(made, tmp_path / "home")
    for text, words in [
        ('workers = "many"', ("workers", "sms.toml")),
        ("wrokers = 2", ("wrokers",)),
        ('database_url = "oracle://scott:tiger@db/sms"', ("database_url",)),
        ("workers = ", ("TOML",)),
    ]:
        (home / "sms.toml").write_text(text)
        refused(home, USAGE, "status", words=words)
        assert "tiger" not in inside("status", "--home", str(home)).stderr


def test_a_database_that_does_not_answer(made: Path) -> None:
    # Port 1 of this machine: nobody listens there.
    environment = {"SMS_DATABASE_URL": "postgresql+psycopg://sms:geheim@127.0.0.1:1/sms"}
    done = inside("status", "--home", str(made), environment=environment)
    assert done.returncode == 7
    assert "does not answer" in done.stderr
    assert "geheim" not in done.stderr


def test_files_that_are_truncated_or_newer(made: Path, tmp_path: Path) -> None:
    home = shutil.copytree(made, tmp_path / "home")
    (file,) = answer("data", "find", "--kind", "calibration", "--home", str(home))
    path = home / "archive" / file["path"]
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    refused(home, CORRUPT, "data", "show", str(file["id"]), words=(file["path"],))
    path.write_bytes(whole)
    with h5py.File(path, "a") as dataset:
        dataset.attrs["format_version"] = 99
    newer = path.read_bytes()
    with closing(sqlite3.connect(home / "catalogue.sqlite")) as catalogue, catalogue:
        # As a newer version would have entered it.
        recorded = (len(newer), hashlib.sha256(newer).hexdigest(), file["id"])
        catalogue.execute("UPDATE file SET size_bytes = ?, sha256 = ? WHERE id = ?", recorded)
    refused(home, CONFLICT, "data", "show", str(file["id"]), words=("99", "newer"))
    path.unlink()
    refused(home, CORRUPT, "data", "show", str(file["id"]), words=(file["path"], "missing"))


def test_output_files_are_not_replaced_unasked(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.h5"
    out.write_text("precious")
    refused(made, CONFLICT, "data", "export", "1", "--out", str(out), words=("--force",))
    image = tmp_path / "out.png"
    image.write_text("precious")
    refused(made, CONFLICT, "data", "plot", "1", "--out", str(image), words=("--force",))
    refused(made, USAGE, "data", "plot", "1", "--out", str(tmp_path / "x.html"), words=(".png",))
    refused(made, USAGE, "data", "provenance", "1", "--output", str(tmp_path / "x.html"), words=(".json",))
    refused(made, USAGE, "data", "export", "1", "--out", str(tmp_path / "no" / "x.h5"), words=("folder",))
    assert out.read_text() == "precious"
