"""The catalogue's schema: created, upgraded and checked through its migrations."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from sqlalchemy import Index
from sqlalchemy.schema import SchemaItem

import sms_jobs
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.models import Table
from sms_jobs.errors import ConfigurationError, FormatTooNew


def configuration() -> Config:
    """Return where the migrations are."""
    found = Config()
    folder = Path(sms_jobs.__file__).parent / "migrations"
    # Config values are interpolated: a percent sign in the path has to be doubled.
    found.set_main_option("script_location", str(folder).replace("%", "%%"))
    found.set_main_option("path_separator", "os")
    return found


def newest_revision() -> str:
    """Return the revision that this version of the program works with."""
    head = ScriptDirectory.from_config(configuration()).get_current_head()
    if head is None:
        raise ConfigurationError("the installation has no migrations; install sms-jobs again")
    return head


def current_revision(catalogue: Catalogue) -> str | None:
    """Return the catalogue's revision; None for an empty database."""
    with catalogue.reading() as session:
        return MigrationContext.configure(session.connection()).get_current_revision()


def upgrade(catalogue: Catalogue, revision: str = "head") -> None:
    """Bring the schema to a revision, the newest by default, in one transaction.

    Raises
    ------
    FormatTooNew
        The catalogue was made by a newer version of the program.
    """
    _refuse_newer(catalogue, current_revision(catalogue))
    migrations = configuration()
    with catalogue.writing() as session:
        migrations.attributes["connection"] = session.connection()
        command.upgrade(migrations, revision)


def require_current(catalogue: Catalogue) -> None:
    """Raise unless the schema is the one that this version of the program works with.

    Raises
    ------
    FormatTooNew
        The catalogue was made by a newer version of the program.
    ConfigurationError
        It is empty or older.
    """
    found = current_revision(catalogue)
    if found == newest_revision():
        return
    _refuse_newer(catalogue, found)
    if found is None:
        raise ConfigurationError(f"the catalogue {catalogue.describe()} is empty; run 'sms init'")
    raise ConfigurationError(
        f"the catalogue {catalogue.describe()} has revision {found}, this version needs "
        f"{newest_revision()}; run 'sms db upgrade'"
    )


def differences_from_models(catalogue: Catalogue) -> list[str]:
    """Return what distinguishes the database's schema from the models; empty when they agree."""
    with catalogue.reading() as session:
        compared = {"compare_type": True, "include_object": partial(_is_compared, catalogue.dialect)}
        context = MigrationContext.configure(session.connection(), opts=compared)
        return [repr(difference) for difference in compare_metadata(context, Table.metadata)]


def _is_compared(dialect: str, thing: SchemaItem, *_: object) -> bool:
    # Alembic does not see on SQLite that an index has a descending column.
    if dialect != "sqlite" or not isinstance(thing, Index):
        return True
    return thing.name not in {"ix_job_next"}


def _refuse_newer(catalogue: Catalogue, found: str | None) -> None:
    if found is None:
        return
    try:
        ScriptDirectory.from_config(configuration()).get_revision(found)
    except CommandError as error:
        raise FormatTooNew(
            f"the catalogue {catalogue.describe()} has revision {found}, newer than {newest_revision()}, the "
            "newest that this version knows; install a newer sms-jobs"
        ) from error
