"""Lets the database know how its tables are filled, so that it takes the index that leads there soonest."""

from __future__ import annotations

from sqlalchemy import text

from sms_jobs.catalogue.database import Catalogue

MANY = 1000
"""After so many new jobs or files the database should look at them."""
_ROWS = 4000
"""Of each index that SQLite looks at: of a million rows all would take seconds, with writers waiting."""


def analyse(catalogue: Catalogue) -> None:
    """Look at every table, as far as it takes less than a second or so.

    Without it SQLite never does, and chooses indexes as if all tables were alike; PostgreSQL does it by
    itself, but only a minute after much has changed.
    """
    if catalogue.dialect != "sqlite":
        with catalogue.writing() as session:
            session.execute(text("ANALYZE"))
        return
    # Which loads every table, and is done after much has changed.
    from sms_jobs.catalogue.tables.every import METADATA

    for table in METADATA.tables:
        # One by one, since others wait who want to write.
        with catalogue.writing() as session:
            session.execute(text(f"PRAGMA analysis_limit = {_ROWS}"))
            session.execute(text(f'ANALYZE "{table}"'))
