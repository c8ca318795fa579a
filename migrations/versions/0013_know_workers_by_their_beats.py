"""Know workers by where they are and by their beats; jobs have no leases of their own any more."""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

_NEW: tuple[tuple[str, sa.types.TypeEngine[Any], Any], ...] = (
    ("machine", sa.String(64), ""),
    ("boot", sa.String(64), ""),
    ("pid_namespace", sa.String(64), ""),
    ("process_started", sa.BigInteger(), "0"),
    ("processes", sa.Integer(), "0"),
    ("lease_s", sa.Double(), "30"),
    ("beats", sa.BigInteger(), "0"),
    ("given_up", sa.Boolean(), sa.false()),
)


def upgrade() -> None:
    """Apply this step."""
    for name, kind, known in _NEW:
        # The value is for workers of before alone: they have ended, and are never heard again.
        op.add_column("worker", sa.Column(name, kind, nullable=False, server_default=known))
    op.drop_column("job", "lease_until")


def downgrade() -> None:
    """Take this step back."""
    op.add_column("job", sa.Column("lease_until", sa.DateTime(timezone=True), nullable=True))
    for name, _, _ in _NEW:
        op.drop_column("worker", name)
