"""Note of campaigns how their specimen's frame was found, so that it can be asked for."""

import sqlalchemy as sa
from alembic import op

revision = "0107"
down_revision = "0106"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    op.add_column("campaign", sa.Column("frame", sa.String(length=16), nullable=True))


def downgrade() -> None:
    """Take this step back."""
    op.drop_column("campaign", "frame")
