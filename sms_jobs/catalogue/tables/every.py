"""Every table at once, for what compares, copies or empties a catalogue as a whole.

A command loads the tables that it asks; to map a class takes as long as most questions.
"""

from sqlalchemy import MetaData, Table

from sms_jobs.catalogue import models
from sms_jobs.catalogue.tables import (  # noqa: F401 - each adds its own
    audit,
    calibrations,
    changes,
    checks,
    files,
    notifications,
    people,
    planned,
    queues,
    runs,
    saved_queries,
    schedules,
)

METADATA: MetaData = models.Table.metadata


def written_tables() -> list[Table]:
    """Return the tables that the program writes itself, those first that others refer to."""
    return [table for table in METADATA.sorted_tables if models.DERIVED not in table.info]
