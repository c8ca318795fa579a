"""What all tables have in common: typed columns for what people ask, JSON for the rest.

Each group of tables is a module of its own: to map a class takes as long as most questions, and a command
maps those that it asks. A module imports the tables that its own refer to.
"""

from datetime import datetime
from typing import Any, ClassVar

from sqlalchemy import JSON, BigInteger, Enum, Integer, MetaData
from sqlalchemy.orm import DeclarativeBase

from sms_jobs.catalogue.tables.columns import UtcDateTime
from sms_jobs.records.job import JobState

BigId = BigInteger().with_variant(Integer(), "sqlite")
JobStateColumn = Enum(
    JobState,
    name="job_state",
    native_enum=False,
    length=16,
    values_callable=lambda states: [s.value for s in states],
)
DERIVED = "derived"
"""Marks a table that the database fills by itself."""


class Table(DeclarativeBase):
    """Base of all tables; constraints have predictable names so that migrations can refer to them."""

    metadata: ClassVar[MetaData] = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map: ClassVar[dict[Any, Any]] = {
        datetime: UtcDateTime,
        JobState: JobStateColumn,
        dict[str, Any]: JSON,
        dict[str, float]: JSON,
    }
