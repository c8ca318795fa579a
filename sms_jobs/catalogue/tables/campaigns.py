"""The tables of campaigns: what is tested, and with which sensors."""

from datetime import datetime
from typing import Any

from sqlalchemy import JSON, ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.columns import String, Text


class SpecimenRow(Table):
    """A thing that is tested."""

    __tablename__ = "specimen"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    material: Mapped[str] = mapped_column(Text)
    description: Mapped[str] = mapped_column(Text)


class RigRow(Table):
    """A set of sensors."""

    __tablename__ = "rig"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)


class CampaignRow(Table):
    """A test of one specimen; `definition` is the whole `Campaign` record."""

    __tablename__ = "campaign"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(64), unique=True)
    specimen_id: Mapped[int] = mapped_column(ForeignKey("specimen.id"), index=True)
    rig_id: Mapped[int] = mapped_column(ForeignKey("rig.id"), index=True)
    created_at: Mapped[datetime]
    definition: Mapped[dict[str, Any]] = mapped_column(deferred=True)
    """Read only where it is asked for: with hundreds of states that takes longer than all else."""
    definition_hash: Mapped[str] = mapped_column(String(64))
    views: Mapped[list[str]] = mapped_column(JSON, server_default="[]")
    """As the definition has them, which with hundreds of states takes long to read."""
    frames: Mapped[int] = mapped_column(server_default="0")
    """Of its whole fringe sequence."""
    frame: Mapped[str | None] = mapped_column(String(16))
    """How the specimen's frame was found; None where nobody has."""
    plan: Mapped[str | None] = mapped_column(Text)
    """The file that it was made from, letter by letter; None where it was made by a program."""
