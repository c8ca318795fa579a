"""Know the definition of a campaign by its hash, so that no worker reads and parses the same one twice."""

import hashlib
import json

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

_CAMPAIGN = sa.table(
    "campaign", sa.column("id"), sa.column("definition", sa.JSON), sa.column("definition_hash")
)


def upgrade() -> None:
    """Apply this step."""
    op.add_column("campaign", sa.Column("definition_hash", sa.String(64), nullable=False, server_default=""))
    connection = op.get_bind()
    for number, definition in connection.execute(sa.select(_CAMPAIGN.c.id, _CAMPAIGN.c.definition)).all():
        canonical = json.dumps(definition, sort_keys=True, separators=(",", ":"))
        known_by = hashlib.sha256(canonical.encode()).hexdigest()
        connection.execute(
            sa.update(_CAMPAIGN).where(_CAMPAIGN.c.id == number).values(definition_hash=known_by)
        )


def downgrade() -> None:
    """Take this step back."""
    op.drop_column("campaign", "definition_hash")
