"""The composition root: settings become the services that everything else is given."""

from __future__ import annotations

import json
import os
import pwd
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from sms_jobs import settings as settings_file
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue import people, renewal, schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.deeds import Deed
from sms_jobs.errors import CatalogueDamaged, CatalogueEmpty, ConfigurationError
from sms_jobs.records.people import Actor, Role, without_secrets
from sms_jobs.records.texts import checked_text
from sms_jobs.settings import Settings

if TYPE_CHECKING:
    from sms_jobs.jobs.devices.stations import Stations


@dataclass(frozen=True)
class Services:
    """What a command or a worker needs to do its work, and for whom it does it."""

    settings: Settings
    catalogue: Catalogue
    archive: Archive
    actor: Actor

    @property
    def stations(self) -> Stations:
        """The rigs that are connected to this host."""
        # Which load the instruments' records: only what works with rigs needs them.
        from sms_jobs.jobs.devices.stations import Stations

        return Stations.of(self.settings)

    def acting(self, actor: Actor) -> Services:
        """Return the same for somebody else."""
        return replace(self, actor=actor)

    def because(self, reason: str) -> Services:
        """Return the same for somebody who says why; raise `InvalidInput` for over 10,000 letters."""
        reason = checked_text(without_secrets(reason.strip()), "a reason")
        return self.acting(replace(self.actor, reason=reason))


def initialise(home: Path | None = None, environment_file: Path | None = None) -> Settings:
    """Make a home: folders, settings file and an up-to-date catalogue; what is there already is kept.

    Folders that are made are for their owner alone.

    Parameters
    ----------
    home
        Its folder; the default one if it is None.
    environment_file
        That the settings file is to name.

    Raises
    ------
    ConfigurationError
        The folder cannot be written, or its settings file is there and names another environment file.
    """
    settings = settings_file.load(home, environment_file)
    file = settings.home / settings_file.FILE_NAME
    try:
        for folder in (settings.home, settings.archive_root, settings.log_folder):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not file.exists():
            file.write_text(_settings_text(settings.environment_file), encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(
            f"the home {settings.home} cannot be made: {error.strerror}: {error.filename}; "
            "choose another `home`"
        ) from error
    named = settings_file.load(settings.home).environment_file
    if named != settings.environment_file:
        raise ConfigurationError(
            f"{file} is there already and names {named or 'no environment file'}: write "
            f"{_naming(settings.environment_file)} into it"
        )
    catalogue = Catalogue(settings.catalogue_url, create=True)
    try:
        schema.upgrade(catalogue)
    finally:
        catalogue.close()
    return settings


def _settings_text(environment_file: Path | None) -> str:
    return _SETTINGS_TEXT + ("" if environment_file is None else _naming(environment_file) + "\n")


def _naming(environment_file: Path | None) -> str:
    return f"environment_file = {json.dumps(str(environment_file))}"


@contextmanager
def services(home: Path | None = None, via: str = "command") -> Iterator[Services]:
    """Open the services of a home that `initialise` has made, for whoever runs this program.

    Raises
    ------
    ConfigurationError
        There is no home, or its catalogue is older than this version needs.
    OtherFormat
        Its catalogue is newer.
    CatalogueDamaged
        It is damaged, or empty or gone although the archive holds files.
    ServerUnreachable
        The database does not answer.
    """
    settings = settings_file.load(home)
    _require_home(settings)
    with closing(_current_catalogue(settings)) as catalogue:
        yield Services(settings, catalogue, _archive(settings), _whoever_runs_this(settings, catalogue, via))


@contextmanager
def renewed(home: Path | None = None, *, dry_run: bool = False) -> Iterator[tuple[Services, str]]:
    """Open the services of a home; a catalogue that is damaged, empty or gone is made anew, without rows.

    With `dry_run` nothing is changed, and such a catalogue is replaced by one that nobody sees.

    Yields
    ------
    Services, and a sentence that says what became of the catalogue; empty when nothing did.

    Raises
    ------
    As `services`; Conflict when the damaged file is in use; ConfigurationError when `database_url` names a
    file outside the home that is no SQLite database.
    """
    settings = settings_file.load(home)
    _require_home(settings)
    url, said = settings.catalogue_url, ""
    file = renewal.file_of(url)
    with TemporaryDirectory() as folder:
        damage = None if file is None else renewal.damage(file)
        if damage is not None and file is not None:
            if renewal.is_other_file(file, settings.home):
                raise ConfigurationError(
                    f"{file} is no SQLite database, and stays as it is: look whether database_url is right; "
                    "if this was the catalogue, move the file away yourself and run this again"
                )
            aside = "" if dry_run else f" to {renewal.set_aside(file)}"
            said = f"the catalogue {file} is damaged ({damage}), and set aside{aside} for a new one"
        elif _is_empty(url):
            said = "the catalogue is empty, and filled anew"
        if said and dry_run:
            url = f"sqlite:///{folder}/catalogue.sqlite"
        with closing(Catalogue(url, create=bool(said))) as catalogue:
            if said:
                schema.upgrade(catalogue)
            schema.require_current(catalogue)
            actor = _whoever_runs_this(settings, catalogue, "command")
            if said:
                said += "; people have no names in it, and its audit begins a new chain"
                _begin_chain(catalogue, actor, said)
            yield Services(settings, catalogue, _archive(settings), actor), said


def _begin_chain(catalogue: Catalogue, actor: Actor, why: str) -> None:
    """Let the first link of a catalogue that was made anew say so."""
    # Which other commands do not load.
    from sms_jobs.catalogue import audit

    with catalogue.writing() as session:
        audit.append(session, Deed(replace(actor, reason=why), "audit.begin", {}), datetime.now(UTC))


def _whoever_runs_this(settings: Settings, catalogue: Catalogue, via: str) -> Actor:
    """Return the person whose account runs this program.

    Until somebody has a name here, everybody who reaches the home may do everything. From then on an
    account is the person of its name, or looks on alone. The account that owns the home
    could change its files anyway.
    """
    name, host = _account(), socket.gethostname()
    with catalogue.reading() as session:
        if not people.has_people(session):
            return Actor(name, Role.ADMINISTRATOR, via, host, confirmed=True)
        row = people.find(session, name)
    if row is not None:
        return Actor(name, Role(row.role), via, host, confirmed=row.password is None)
    owns = settings.home.stat().st_uid == os.getuid()
    return Actor(name, Role.ADMINISTRATOR if owns else Role.VIEWER, via, host, confirmed=owns)


def _account() -> str:
    try:
        return pwd.getpwuid(os.getuid()).pw_name[:64]
    except KeyError:
        # Containers run under numbers that have no name.
        return f"uid {os.getuid()}"


def _require_home(settings: Settings) -> None:
    if settings.home.is_dir():
        return
    if settings.home.exists():
        raise ConfigurationError(f"{settings.home} is no folder, and a home is one; give another `home`")
    raise ConfigurationError(f"there is no home at {settings.home}; run 'sms init --home {settings.home}'")


def _archive(settings: Settings) -> Archive:
    if not settings.archive_root.is_dir():
        # Not made here: a share that is not mounted, or a name that was mistyped, must not go unnoticed.
        raise ConfigurationError(
            f"there is no folder {settings.archive_root} of the archive; mount it, correct the setting "
            f"'archive', or run 'sms init --home {settings.home}'"
        )
    return open_archive(settings)


def open_archive(settings: Settings) -> Archive:
    """Return the archive that the settings name; here it is decided what store it has."""
    return Archive(FolderStore(settings.archive_root))


def _current_catalogue(settings: Settings) -> Catalogue:
    try:
        catalogue = Catalogue(settings.catalogue_url)
        try:
            schema.require_current(catalogue)
        except BaseException:
            catalogue.close()
            raise
    except CatalogueEmpty as error:
        found = str(error).partition(";")[0]
        if not _archive_has_files(settings):
            # Named, since it may be another home than the one that 'sms init' makes where none is given.
            raise CatalogueEmpty(f"{found}; run 'sms init --home {settings.home}'") from error
        raise CatalogueDamaged(
            f"{found}, although there are files in the archive "
            f"{settings.archive_root}; end "
            "the service, then restore a backup, or run 'sms archive reindex', which enters these files again"
        ) from error
    return catalogue


def _archive_has_files(settings: Settings) -> bool:
    return settings.archive_root.is_dir() and next(open_archive(settings).files(), None) is not None


def _is_empty(url: str) -> bool:
    try:
        with closing(Catalogue(url)) as catalogue:
            return schema.current_revision(catalogue) is None
    except CatalogueEmpty:
        return True


_SETTINGS_TEXT = """\
# Settings of this home. Environment variables (SMS_DATABASE_URL, SMS_WORKERS, ...) win over this file.
# workers = 2            # jobs that run at the same time
# threads = 1            # threads that each of them may use
# archive = "/data/sms"  # folder of the sealed files
# database_url = "postgresql+psycopg://sms@db.example/sms"
# broker_url = "redis://broker.example:6379/0"
"""
