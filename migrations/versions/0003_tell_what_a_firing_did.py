"""Tell in words what became of a schedule's firing."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    with op.batch_alter_table("schedule_fire") as fire:
        fire.alter_column(
            "outcome", existing_type=sa.String(length=16), type_=sa.Text(), existing_nullable=False
        )


def downgrade() -> None:
    """Take this step back."""
    op.execute("UPDATE schedule_fire SET outcome = substr(outcome, 1, 16)")
    with op.batch_alter_table("schedule_fire") as fire:
        fire.alter_column(
            "outcome", existing_type=sa.Text(), type_=sa.String(length=16), existing_nullable=False
        )
