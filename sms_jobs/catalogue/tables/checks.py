"""The table of what was found when a file of the archive was last compared with what was sealed."""

from datetime import datetime

from sqlalchemy import ForeignKey
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import Table
from sms_jobs.catalogue.tables.columns import String, Text
from sms_jobs.catalogue.tables.files import FileRow


class FileCheckRow(Table):
    """The last comparison of a file; one without a row was never compared since it was sealed."""

    __tablename__ = "file_check"
    file_id: Mapped[int] = mapped_column(ForeignKey(FileRow.id), primary_key=True, autoincrement=False)
    checked_at: Mapped[datetime]
    problem: Mapped[str | None] = mapped_column(String(16))
    """As in `jobs.verification.Problem`; None for a file that is as it was sealed."""
    detail: Mapped[str] = mapped_column(Text, default="")
