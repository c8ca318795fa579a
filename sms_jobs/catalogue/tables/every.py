"""Every table at once, for what compares, copies or empties a catalogue as a whole.

A command loads the tables that it asks; to map a class takes as long as most questions.
"""

import sqlalchemy

from sms_jobs.catalogue.tables import (  # noqa: F401 - each adds its own
    access,
    audit,
    calibrations,
    campaigns,
    changes,
    checks,
    files,
    job_counts,
    jobs,
    notifications,
    people,
    planned,
    queues,
    runs,
    saved_queries,
    schedules,
    states,
    workers,
)
from sms_jobs.catalogue.tables.base import DERIVED, Table

METADATA: sqlalchemy.MetaData = Table.metadata


def written_tables() -> list[sqlalchemy.Table]:
    """Return the tables that the program writes itself, those first that others refer to."""
    return [table for table in METADATA.sorted_tables if DERIVED not in table.info]
