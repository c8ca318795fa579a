"""A catalogue that is damaged, emptied or gone: every command says what to do, and doing so helps."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from support.command import inside
from support.examining import doctor
from support.homes import make_home
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.catalogue import renewal
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.cli import archive as command
from sms_jobs.errors import CatalogueEmpty, ConfigurationError, Conflict
from sms_jobs.jobs.asking import inquiry


def scribble(file: Path, start: int, size: int) -> None:
    """Overwrite a part of a file."""
    with file.open("r+b") as stream:
        stream.seek(start)
        stream.write(b"?" * size)


def without_tables(file: Path) -> None:
    """Put a database that has none in the place of a file."""
    file.unlink()
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA user_version = 3")


DAMAGES: dict[str, Callable[[Path], object]] = {
    "header": lambda file: scribble(file, 0, 200),
    "pages": lambda file: scribble(file, 3 * 4096, 20 * 4096),
    "half": lambda file: file.write_bytes(file.read_bytes()[:30_000]),
    "emptied": lambda file: file.write_bytes(b""),
    "gone": lambda file: file.unlink(),
    "without tables": without_tables,
}
BRIEFLY = ("header", "half", "emptied", "without tables")
# Of the rest nothing is left that could be set aside.
DAMAGED = ("header", "pages", "half")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with a campaign in it."""
    home = tmp_path_factory.mktemp("sound") / "home"
    make_home(home, {})
    return home


def reindex(home: Path, *options: str) -> tuple[int, str]:
    done = CliRunner().invoke(command.app, ["reindex", *options, "--home", str(home)])
    return done.exit_code, done.output


def advised(home: Path) -> bool:
    """Tell whether `sms doctor` finds that the files are to be entered again."""
    code, findings = doctor(home)
    assert code == 6
    assert "sms init" not in "".join(findings.values())
    return any("'sms archive reindex'" in finding for finding in findings.values())


@pytest.mark.parametrize(
    "how", [how if how in BRIEFLY else pytest.param(how, marks=pytest.mark.long) for how in DAMAGES]
)
def test_the_advice_is_to_reindex_and_following_it_helps(sound: Path, home: Path, how: str) -> None:
    shutil.copytree(sound, home, dirs_exist_ok=True)
    file = home / "catalogue.sqlite"
    DAMAGES[how](file)
    damaged = file.read_bytes() if how in DAMAGED else None
    assert advised(home)
    if how in ("header", "emptied"):
        assert reindex(home, "--dry-run")[0] == 0
        assert advised(home)
    code, said = reindex(home)
    assert (code, "filled anew" in said or "set aside" in said) == (0, True)
    assert not advised(home)
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        assert inquiry.campaign_names(session) == ["plate"]
    aside = file.with_name("catalogue.sqlite.damaged-1")
    # Nothing is deleted.
    assert (aside.read_bytes() if aside.exists() else None) == damaged


def test_a_new_home_is_not_damaged(home: Path) -> None:
    with pytest.raises(CatalogueEmpty, match="sms init"), bootstrap.services(home):
        pass


def test_a_damaged_catalogue_that_is_in_use_stays_where_it_is(sound: Path, home: Path) -> None:
    shutil.copytree(sound, home, dirs_exist_ok=True)
    file = home / "catalogue.sqlite"
    with closing(Catalogue(f"sqlite:///{file}")) as catalogue, catalogue.reading() as session:
        inquiry.counts(session)
        # A lock of this process would not keep it from anything: ask from another.
        probe = (
            "import sys; from pathlib import Path; from sms_jobs.catalogue import renewal\n"
            "renewal.set_aside(Path(sys.argv[1]))"
        )
        done = subprocess.run(
            [sys.executable, "-c", probe, str(file)], capture_output=True, text=True, check=False
        )
    assert f"{Conflict.__name__}: the damaged catalogue {file} is in use" in done.stderr
    assert file.exists()
    assert renewal.set_aside(file).exists()


@pytest.mark.parametrize(
    "content", [b"minutes of a meeting\n", b"\x89PNG\r\n" + bytes(5000)], ids=["text", "picture"]
)
def test_a_file_that_was_never_a_catalogue_stays_as_it_is(
    sound: Path, home: Path, content: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(sound, home / "home")
    stranger = home / "stranger"
    stranger.write_bytes(content)
    monkeypatch.setenv("SMS_DATABASE_URL", f"sqlite:///{stranger}")
    done = inside("archive", "reindex", "--home", str(home / "home"))
    assert done.returncode == ConfigurationError.exit_code
    assert "look whether database_url is right" in done.stderr
    assert stranger.read_bytes() == content
    assert sorted(path.name for path in home.iterdir()) == ["home", "stranger"]


def test_a_database_of_another_program_is_given_no_tables(
    sound: Path, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(sound, home / "home")
    stranger = home / "addresses.sqlite"
    with closing(sqlite3.connect(stranger)) as connection, connection:
        connection.execute("CREATE TABLE address (street)")
    monkeypatch.setenv("SMS_DATABASE_URL", f"sqlite:///{stranger}")
    for command_line in (("init",), ("archive", "reindex"), ("status",), ("db", "upgrade")):
        done = inside(*command_line, "--home", str(home / "home"))
        assert done.returncode == ConfigurationError.exit_code, command_line
        assert "is another program's (it has a table 'address')" in done.stderr
    with closing(sqlite3.connect(stranger)) as connection:
        assert connection.execute("SELECT name FROM sqlite_schema").fetchall() == [("address",)]
