"""Of a SQLite file each connection keeps what it was told to."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import text

from sms_jobs import bootstrap


def test_connections_that_are_opened_later_keep_so_many_pages(home: Path) -> None:
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        services.catalogue.keep_pages(400)
        services.catalogue.engine.dispose()
        for catalogue in (services.catalogue, services.catalogue.for_reading()):
            with catalogue.reading() as session:
                # Negative numbers are kilobytes, others pages.
                assert session.scalar(text("PRAGMA cache_size")) == -400
