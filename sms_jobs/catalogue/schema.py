"""The catalogue's schema: created, upgraded and checked through its migrations.

Alembic is loaded where something is migrated or compared: every command checks the revision.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import Index, inspect, text
from sqlalchemy.schema import SchemaItem

import sms_jobs
from sms_jobs.catalogue import job_counts
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import CatalogueEmpty, ConfigurationError, OtherFormat

if TYPE_CHECKING:
    from alembic.config import Config

_TRIGGERS = {
    "sqlite": "SELECT name FROM sqlite_master WHERE type = 'trigger'",
    "postgresql": "SELECT tgname FROM pg_trigger WHERE tgenabled = 'O' AND NOT tgisinternal",
}
_MIGRATIONS = Path(sms_jobs.__file__).parent / "migrations"


def configuration() -> Config:
    """Return where the migrations are."""
    from alembic.config import Config

    found = Config()
    # Config values are interpolated: a percent sign in the path has to be doubled.
    found.set_main_option("script_location", str(_MIGRATIONS).replace("%", "%%"))
    found.set_main_option("path_separator", "os")
    return found


def revisions() -> tuple[str, ...]:
    """Return the revisions that this version of the program knows, in order; files begin with them."""
    return tuple(sorted(file.name.partition("_")[0] for file in _MIGRATIONS.glob("versions/[0-9]*.py")))


def newest_revision() -> str:
    """Return the revision that this version of the program works with."""
    versions = revisions()
    if not versions:
        raise ConfigurationError("the installation has no migrations; install sms-jobs again")
    return versions[-1]


def current_revision(catalogue: Catalogue) -> str | None:
    """Return the catalogue's revision; None for an empty database.

    Raises
    ------
    ConfigurationError
        The database is another program's.
    """
    with catalogue.reading() as session:
        tables = inspect(session.connection()).get_table_names()
        if not tables:
            return None
        if "alembic_version" not in tables:
            raise ConfigurationError(
                f"the database {catalogue.describe()} is another program's (it has a table '{tables[0]}'); "
                "give the catalogue a database of its own"
            )
        found: str | None = session.scalar(text("SELECT version_num FROM alembic_version"))
        return found


def upgrade(catalogue: Catalogue, revision: str = "head") -> None:
    """Bring the schema to a revision, the newest by default, in one transaction.

    A catalogue that has the newest is left alone, and Alembic is not loaded for it.

    Raises
    ------
    OtherFormat
        The catalogue was made by a newer version of the program, or before the first release.
    """
    found = current_revision(catalogue)
    if revision == "head" and found == newest_revision():
        return
    _refuse_newer(catalogue, found)
    from alembic import command

    migrations = configuration()
    with catalogue.writing() as session:
        migrations.attributes["connection"] = session.connection()
        command.upgrade(migrations, revision)


def require_current(catalogue: Catalogue) -> None:
    """Raise unless the schema is the one that this version of the program works with.

    Raises
    ------
    OtherFormat
        The catalogue was made by a newer version of the program, or before the first release.
    CatalogueEmpty
        It has no tables.
    ConfigurationError
        It is older.
    """
    found = current_revision(catalogue)
    if found == newest_revision():
        return
    _refuse_newer(catalogue, found)
    if found is None:
        raise CatalogueEmpty(f"the catalogue {catalogue.describe()} is empty; run 'sms init'")
    raise ConfigurationError(
        f"the catalogue {catalogue.describe()} has revision {found}, this version needs "
        f"{newest_revision()}; run 'sms db upgrade'"
    )


def differences_from_models(catalogue: Catalogue) -> list[str]:
    """Return what distinguishes the database's schema from the models; empty when they agree."""
    from alembic.autogenerate import compare_metadata
    from alembic.runtime.migration import MigrationContext

    from sms_jobs.catalogue.tables.every import METADATA

    with catalogue.reading() as session:
        compared = {"compare_type": True, "include_object": partial(_is_compared, catalogue.dialect)}
        context = MigrationContext.configure(session.connection(), opts=compared)
        found = [repr(difference) for difference in compare_metadata(context, METADATA)]
        there = set(session.scalars(text(_TRIGGERS[catalogue.dialect])))
        return [*found, *(f"no trigger {name}" for name in sorted(job_counts.TRIGGERS - there))]


def _is_compared(dialect: str, thing: SchemaItem, *_: object) -> bool:
    # Alembic does not see on SQLite that an index has a descending column.
    if dialect != "sqlite" or not isinstance(thing, Index):
        return True
    return thing.name not in {"ix_job_next"}


def _refuse_newer(catalogue: Catalogue, found: str | None) -> None:
    versions = revisions()
    if found is not None and found < versions[0]:
        raise OtherFormat(
            f"the catalogue {catalogue.describe()} has revision {found}, from before the first release; this "
            f"version reads {versions[0]} and later: start again with 'sms init' in another home"
        )
    if found is not None and found not in versions:
        raise OtherFormat(
            f"the catalogue {catalogue.describe()} has revision {found}, newer than {newest_revision()}, the "
            "newest that this version knows; install a newer sms-jobs"
        )
