"""Hold workers whose archive cannot be used, and count how often a job was tried by a column."""

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    op.add_column("worker", sa.Column("held_for", sa.Text(), nullable=True))
    op.add_column("worker", sa.Column("held_at", sa.String(length=200), nullable=True))
    # What was tried before is forgotten: at the worst a job has three chances more.
    op.add_column("job", sa.Column("tries", sa.Integer(), nullable=False, server_default="0"))
    if op.get_bind().dialect.name == "postgresql":
        op.alter_column("job", "tries", server_default=None)


def downgrade() -> None:
    """Take this step back."""
    op.drop_column("job", "tries")
    op.drop_column("worker", "held_at")
    op.drop_column("worker", "held_for")
