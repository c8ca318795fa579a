"""Where the home is, which servers are used, and how much of the machine a worker takes.

Environment variables (`SMS_...`) win over the environment file that `sms.toml` in the home may name, this
over `sms.toml` itself, and this over the defaults.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, SecretStr, ValidationError

from sms_jobs.errors import ConfigurationError, in_words

FILE_NAME = "sms.toml"
_PREFIX = "SMS_"
_LONGEST_NAME, _LONGEST_PATH = 255, 4095
"""Bytes that Linux and macOS take at most in a name, and Linux in a path."""


def _possible(place: Path) -> Path:
    """Refuse what no file system has a place for, before one is asked."""
    longest = max((len(os.fsencode(part)) for part in place.parts), default=0)
    if longest > _LONGEST_NAME or len(os.fsencode(place)) > _LONGEST_PATH:
        raise ValueError(
            f"a name in it has {longest} bytes, and {_LONGEST_NAME} are possible, {_LONGEST_PATH} in all"
        )
    return place


_Place = Annotated[Path, AfterValidator(_possible)]


class Settings(BaseModel):
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
        Folder of the sealed files, from the home if it is relative; empty for `archive` in the home.
    spool
        Folder, on a disk of this host, for frames as they come in; empty for `spool` in the home.
    environment_file
        File of environment variables, as systemd reads it, for what `sms.toml` should not hold, such as
        passwords; it has to be there. In `sms.toml` alone.
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
        No job is started with less room than this (in MB of a million bytes) on the archive's disk.
    openid_issuer, openid_client_id, openid_client_secret
        The identity provider by which people may log in to the console, what it calls this program, and the
        secret that it gave to it; empty for none.
    stop_grace_s
        How long a job that is asked to stop may take to reach a checkpoint before it is ended by a signal;
        after twice this it is killed.
    console_url
        Of the web console, as people reach it, for notifications to lead there; empty for none.
    smtp_host, smtp_port, smtp_user, smtp_password
        Of the mail server that notifications go through; without a user nobody is logged in.
    smtp_from
        Address that they come from.
    smtp_security
        `starttls`, `tls` from the first byte on, or `none`, which is for servers that need no password.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    home: Path
    database_url: SecretStr = SecretStr("")
    broker_url: SecretStr = SecretStr("")
    archive: _Place | None = None
    spool: _Place | None = None
    environment_file: _Place | None = None
    workers: int = Field(default_factory=lambda: os.cpu_count() or 1, ge=1, le=256)
    threads: int = Field(default=1, ge=1, le=256)
    lease_s: float = Field(default=30.0, ge=1.0, le=3600.0)
    crash_budget: int = Field(default=3, ge=1, le=100)
    job_time_limit_s: float = Field(default=0.0, ge=0.0)
    job_memory_limit_mb: float = Field(default=0.0, ge=0.0)
    least_room_mb: float = Field(default=256.0, ge=0.0)
    openid_issuer: str = ""
    openid_client_id: str = ""
    openid_client_secret: SecretStr = SecretStr("")
    stop_grace_s: float = Field(default=15.0, ge=0.1, le=3600.0)
    console_url: str = ""
    smtp_host: str = ""
    smtp_port: int = Field(default=587, ge=1, le=65535)
    smtp_user: str = ""
    smtp_password: SecretStr = SecretStr("")
    smtp_from: str = ""
    smtp_security: Literal["starttls", "tls", "none"] = "starttls"

    @property
    def catalogue_url(self) -> str:
        """Return the catalogue's URL, with its password."""
        return self.database_url.get_secret_value() or f"sqlite:///{self.home / 'catalogue.sqlite'}"

    @property
    def archive_root(self) -> Path:
        """Return the folder of the sealed files."""
        return self.home / (self.archive or "archive")

    @property
    def spool_folder(self) -> Path:
        """Return the folder for frames as they come in, one folder a job."""
        return self.home / (self.spool or "spool")

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
    def kernels_left_file(self) -> Path:
        """Return the file that says how many kernels are missing; it is there while they are compiled."""
        return self.log_folder / "kernels-left"

    @property
    def job_log_folder(self) -> Path:
        """Return the folder of the jobs' logs: where every host sees them, beside what the jobs made."""
        return self.archive_root / ".logs"


def default_home() -> Path:
    """Return the home that is used when none is named.

    That is `SMS_HOME`, or the user's own folder where it is a home, as that of a service's account is, or
    `sms-home` in it.
    """
    if named := os.environ.get("SMS_HOME"):
        return Path(named)
    own = Path.home()
    return own if (own / FILE_NAME).is_file() else own / "sms-home"


def load(home: Path | None = None, environment_file: Path | None = None) -> Settings:
    """Read the settings of a home; with another environment file than it names, if one is given.

    Raises
    ------
    ConfigurationError
        A value cannot be used; the message names it, never a secret.
    """
    folder = (home or default_home()).expanduser().absolute()
    given = _of_home(folder / FILE_NAME) | {"home": folder}
    if environment_file is not None:
        given["environment_file"] = environment_file.absolute()
    if named := given.get("environment_file"):
        given |= _of_environment_file(Path(str(named)))
    try:
        return Settings(**given | _settings_among(os.environ.items()))
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"]) or "settings"
        if first["type"] == "extra_forbidden":
            near = get_close_matches(name, Settings.model_fields, 1)
            meant = f"did you mean '{near[0]}'" if near else "docs/configuration.md has all"
            raise ConfigurationError(
                f"there is no setting '{name}' ({folder / FILE_NAME}); {meant}"
            ) from error
        raise ConfigurationError(
            f"the setting '{name}' ({folder / FILE_NAME} or SMS_{name.upper()}) "
            f"cannot be used: {in_words(first['msg'])}"
        ) from error


def _of_home(file: Path) -> dict[str, Any]:
    try:
        with file.open("rb") as opened:
            return tomllib.load(opened)
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{file} is not valid TOML: {error or 'nested too deeply'}") from error
    except OSError as error:
        raise ConfigurationError(f"{file} cannot be read: {error.strerror}") from error


def _settings_among(variables: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the settings among environment variables; there may be any others."""
    named = ((name.upper(), value) for name, value in variables)
    found = {n.removeprefix(_PREFIX).lower(): value for n, value in named if n.startswith(_PREFIX)}
    known = set(Settings.model_fields) - {"home", "environment_file"}
    return {name: value for name, value in found.items() if name in known}


def _of_environment_file(path: Path) -> dict[str, str]:
    """Return the settings in a file of environment variables; `ConfigurationError` where it is not there."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text"
        raise ConfigurationError(
            f"settings of this home are in {path}, which cannot be read ({why}): restore it, run this as an "
            f"account that may read it, or correct 'environment_file' in {FILE_NAME}"
        ) from error
    pairs = (line.strip().partition("=") for line in lines)
    return _settings_among((name, _unquoted(value.strip())) for name, _, value in pairs)


def _unquoted(value: str) -> str:
    quoted = len(value) > 1 and value[0] == value[-1] and value[0] in "\"'"
    return value[1:-1] if quoted else value
