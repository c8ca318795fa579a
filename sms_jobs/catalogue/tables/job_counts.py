"""The table of how many jobs there are, which the database fills by itself."""

from sqlalchemy import BigInteger
from sqlalchemy.orm import Mapped, mapped_column

from sms_jobs.catalogue.tables.base import DERIVED, Table
from sms_jobs.catalogue.tables.columns import String
from sms_jobs.records.job import JobState


class JobCountRow(Table):
    """How many jobs of a campaign, kind and queue are in a state: the sum of `jobs` over all parts.

    Nobody writes it but triggers on `job`; see `catalogue.job_counts`.
    """

    __tablename__ = "job_count"
    __table_args__ = ({"info": {DERIVED: True}},)
    campaign_id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    kind: Mapped[str] = mapped_column(String(32), primary_key=True)
    queue: Mapped[str] = mapped_column(String(80), primary_key=True)
    state: Mapped[JobState] = mapped_column(primary_key=True)
    part: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    jobs: Mapped[int] = mapped_column(BigInteger)
