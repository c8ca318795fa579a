"""The composition root: settings become the services that everything else is given."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from sms_jobs import settings as settings_file
from sms_jobs.archive import Archive
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import ConfigurationError
from sms_jobs.jobs.stations import Stations
from sms_jobs.settings import Settings


@dataclass(frozen=True)
class Services:
    """What a command or a worker needs to do its work."""

    settings: Settings
    catalogue: Catalogue
    archive: Archive

    @property
    def stations(self) -> Stations:
        """The rigs that are connected to this host."""
        return Stations.of(self.settings)


def initialise(home: Path | None = None) -> Settings:
    """Make a home: folders, settings file and an up-to-date catalogue; what is there already is kept.

    Raises
    ------
    ConfigurationError
        The folder cannot be written.
    """
    settings = settings_file.load(home)
    try:
        for folder in (settings.home, settings.archive_root, settings.log_folder):
            folder.mkdir(parents=True, exist_ok=True)
        file = settings.home / settings_file.FILE_NAME
        if not file.exists():
            file.write_text(_SETTINGS_TEXT, encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(
            f"the home {settings.home} cannot be made: {error.strerror}: {error.filename}; "
            "choose another with --home"
        ) from error
    catalogue = Catalogue(settings.catalogue_url, create=True)
    try:
        schema.upgrade(catalogue)
    finally:
        catalogue.close()
    return settings


@contextmanager
def services(home: Path | None = None) -> Iterator[Services]:
    """Open the services of a home that `initialise` has made.

    Raises
    ------
    ConfigurationError
        There is no home, or its catalogue is older than this version needs.
    FormatTooNew
        Its catalogue is newer.
    ServerUnreachable
        The database does not answer.
    """
    settings = settings_file.load(home)
    if not settings.home.is_dir():
        raise ConfigurationError(
            f"there is no home at {settings.home}; run 'sms init --home {settings.home}'"
        )
    catalogue = Catalogue(settings.catalogue_url)
    try:
        schema.require_current(catalogue)
        yield Services(settings, catalogue, Archive(settings.archive_root))
    finally:
        catalogue.close()


_SETTINGS_TEXT = """\
# Settings of this home. Environment variables (SMS_DATABASE_URL, SMS_WORKERS, ...) win over this file.
# workers = 2            # jobs that run at the same time
# threads = 1            # threads that each of them may use
# archive = "/data/sms"  # folder of the sealed files
# database_url = "postgresql+psycopg://sms@db.example/sms"
# broker_url = "redis://broker.example:6379/0"
"""
