"""Know files by their bytes too, so that a whole one is compared without reading it as HDF5."""

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    op.add_column("file", sa.Column("sha256", sa.String(64), nullable=False, server_default=""))


def downgrade() -> None:
    """Take this step back."""
    op.drop_column("file", "sha256")
