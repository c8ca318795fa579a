"""Keep the file that a campaign was made from, letter by letter."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    with op.batch_alter_table("campaign") as campaign:
        campaign.add_column(sa.Column("plan", sa.Text(), nullable=True))


def downgrade() -> None:
    """Take this step back."""
    with op.batch_alter_table("campaign") as campaign:
        campaign.drop_column("plan")
