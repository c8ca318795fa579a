"""A home whose settings are in the file of environment variables of a service."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sms_jobs import bootstrap
from sms_jobs import settings as settings_file
from sms_jobs.errors import ConfigurationError

FILE = """\
# What systemd reads too.
SMS_WORKERS=3
SMS_BROKER_URL='redis://:s p=a#m@broker.example:6379/0'
SMS_HOME=/elsewhere
DISPLAY=:0
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    made = tmp_path / "sms.env"
    made.write_text(FILE)
    return made


def test_a_home_finds_the_file_that_it_names(
    tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home"
    assert bootstrap.initialise(home, file).workers == 3
    found = settings_file.load(home)
    assert found.broker_url.get_secret_value() == "redis://:s p=a#m@broker.example:6379/0"
    assert found.home == home
    monkeypatch.setenv("SMS_WORKERS", "5")
    assert settings_file.load(home).workers == 5


def test_without_it_nothing_is_opened(tmp_path: Path, file: Path) -> None:
    home = tmp_path / "home"
    database = tmp_path / "server.sqlite"
    file.write_text(f"SMS_DATABASE_URL=sqlite:///{database}\n")
    bootstrap.initialise(home, file)
    assert database.exists()
    file.unlink()
    why = r"sms\.env, which cannot be read \(No such file"
    with pytest.raises(ConfigurationError, match=why), bootstrap.services(home):
        pass
    with pytest.raises(ConfigurationError, match="which cannot be read"):
        bootstrap.initialise(home)
    assert not (home / "catalogue.sqlite").exists()
    with pytest.raises(ConfigurationError, match="which cannot be read"):
        bootstrap.initialise(tmp_path / "other", file)
    assert not (tmp_path / "other").exists()


def test_a_home_that_names_another_file_is_told(tmp_path: Path, file: Path) -> None:
    bootstrap.initialise(tmp_path / "home")
    with pytest.raises(ConfigurationError, match=r"names no environment file: write environment_file = \""):
        bootstrap.initialise(tmp_path / "home", file)


def test_the_folder_of_an_account_may_be_its_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("SMS_HOME", raising=False)
    assert settings_file.default_home() == tmp_path / "sms-home"
    bootstrap.initialise(tmp_path)
    assert settings_file.default_home() == tmp_path


def test_the_folders_of_a_home_are_for_its_owner(tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        settings = bootstrap.initialise(tmp_path / "deep" / "home")
    finally:
        os.umask(before)
    for folder in (settings.home, settings.archive_root, settings.log_folder):
        assert folder.stat().st_mode & 0o777 == 0o700
