"""Ring for queues as long as jobs are queued in them, and forget when that was done for each job."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    op.drop_column("job", "rung_at")


def downgrade() -> None:
    """Take this step back."""
    op.add_column("job", sa.Column("rung_at", sa.DateTime(timezone=True), nullable=True))
