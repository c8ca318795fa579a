"""Where the home is, which servers are used, and how much of the machine a worker takes.

Environment variables (`SMS_...`) win over `sms.toml` in the home, which wins over the defaults.
"""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

from pydantic import Field, SecretStr, ValidationError
from pydantic_settings import (
    BaseSettings,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from sms_jobs.errors import ConfigurationError

FILE_NAME = "sms.toml"


class Settings(BaseSettings):
    """Settings of one installation.

    Attributes
    ----------
    home
        Folder of the embedded catalogue, archive, messages and logs.
    database_url
        Of the catalogue; empty for SQLite in the home.
    broker_url
        Of the message broker (`redis://...`); empty for files in the home.
    archive
        Folder of the sealed files; empty for `archive` in the home.
    spool
        Folder, on a disk of this host, for frames as they come in; empty for `spool` in the home.
    workers
        Jobs that run at the same time under one supervisor.
    threads
        Threads that each of them may use.
    lease_s
        How long a job stays with a worker that gives no sign of life.
    crash_budget
        How many times a job may bring its worker down before it is quarantined.
    job_time_limit_s, job_memory_limit_mb
        What one job may take before it is stopped and fails; 0 for no limit.
    least_room_mb
        No job is begun with less room than this (in MB of a million bytes) on the archive's disk.
    stop_grace_s
        How long a job that is asked to stop may take to reach a checkpoint before it is ended by a signal;
        after twice this it is killed.
    """

    model_config = SettingsConfigDict(env_prefix="SMS_", frozen=True, extra="forbid")

    home: Path
    database_url: SecretStr = SecretStr("")
    broker_url: SecretStr = SecretStr("")
    archive: Path | None = None
    spool: Path | None = None
    workers: int = Field(default_factory=lambda: os.cpu_count() or 1, ge=1, le=256)
    threads: int = Field(default=1, ge=1, le=256)
    lease_s: float = Field(default=30.0, ge=1.0, le=3600.0)
    crash_budget: int = Field(default=3, ge=1, le=100)
    job_time_limit_s: float = Field(default=0.0, ge=0.0)
    job_memory_limit_mb: float = Field(default=0.0, ge=0.0)
    least_room_mb: float = Field(default=256.0, ge=0.0)
    stop_grace_s: float = Field(default=15.0, ge=0.1, le=3600.0)

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Put the home's file between the environment and the defaults."""
        home = init_settings().get("home")
        return (
            init_settings,
            env_settings,
            TomlConfigSettingsSource(settings_cls, Path(str(home)) / FILE_NAME),
        )

    @property
    def catalogue_url(self) -> str:
        """Return the catalogue's URL, with its password."""
        return self.database_url.get_secret_value() or f"sqlite:///{self.home / 'catalogue.sqlite'}"

    @property
    def archive_root(self) -> Path:
        """Return the folder of the sealed files."""
        return self.archive or self.home / "archive"

    @property
    def spool_folder(self) -> Path:
        """Return the folder for frames as they come in, one folder a job."""
        return self.spool or self.home / "spool"

    @property
    def rig_folder(self) -> Path:
        """Return the folder of the files of the rigs that are connected to this host."""
        return self.home / "rigs"

    @property
    def message_folder(self) -> Path:
        """Return the folder of the embedded message transport."""
        return self.home / "messages"

    @property
    def log_folder(self) -> Path:
        """Return the folder of the workers' logs."""
        return self.home / "logs"

    @property
    def job_log_folder(self) -> Path:
        """Return the folder of the jobs' logs: where every host sees them, beside what the jobs made."""
        return self.archive_root / ".logs"


def default_home() -> Path:
    """Return the home that is used when none is named: `SMS_HOME`, or `sms-home` in the user's folder."""
    return Path(os.environ.get("SMS_HOME") or Path.home() / "sms-home")


def load(home: Path | None = None) -> Settings:
    """Read the settings of a home.

    Raises
    ------
    ConfigurationError
        A value cannot be used; the message names it, never a secret.
    """
    folder = (home or default_home()).expanduser().absolute()
    try:
        return Settings(home=folder)
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"]) or "settings"
        raise ConfigurationError(
            f"the setting '{name}' ({folder / FILE_NAME} or SMS_{name.upper()}) "
            f"cannot be used: {first['msg']}"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{folder / FILE_NAME} is not valid TOML: {error}") from error
    except OSError as error:
        raise ConfigurationError(f"{folder / FILE_NAME} cannot be read: {error.strerror}") from error
