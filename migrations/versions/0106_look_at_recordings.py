"""Note which planned recordings are looked at, and where that stops their plan."""

import sqlalchemy as sa
from alembic import op

revision = "0106"
down_revision = "0105"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    table, no = "planned_recording", sa.false()
    op.add_column(table, sa.Column("look", sa.Boolean(), server_default=no, nullable=False))
    op.add_column(table, sa.Column("stop_if", sa.JSON(), server_default="[]", nullable=False))
    op.add_column(table, sa.Column("awaited", sa.Boolean(), server_default=no, nullable=False))
    op.add_column(table, sa.Column("stopped_by", sa.Text(), nullable=True))


def downgrade() -> None:
    """Take this step back."""
    for name in ("stopped_by", "awaited", "stop_if", "look"):
        op.drop_column("planned_recording", name)
