"""Note views and frames of campaigns beside their definitions, and lead to the latest jobs by an index."""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0103"
down_revision = "0102"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    op.add_column("campaign", sa.Column("views", sa.JSON(), server_default="[]", nullable=False))
    op.add_column("campaign", sa.Column("frames", sa.Integer(), server_default="0", nullable=False))
    op.create_index(op.f("ix_job_position"), "job", ["position"])
    op.create_index(op.f("ix_job_kind_position"), "job", ["kind", "position"])
    op.create_index(op.f("ix_job_state_position"), "job", ["state", "position"])
    number, definition = sa.column("id", sa.Integer()), sa.column("definition", sa.JSON())
    views, frames = sa.column("views", sa.JSON()), sa.column("frames", sa.Integer())
    campaign = sa.table("campaign", number, definition, views, frames)
    connection = op.get_bind()
    for (key,) in connection.execute(sa.select(number).select_from(campaign)).all():
        found: Any = connection.scalar(sa.select(definition).select_from(campaign).where(number == key))
        noted = {"views": found.get("views", []), "frames": _frames(found.get("sequence", {}))}
        connection.execute(sa.update(campaign).where(number == key).values(noted))


def downgrade() -> None:
    """Take this step back."""
    op.drop_index(op.f("ix_job_state_position"), table_name="job")
    op.drop_index(op.f("ix_job_kind_position"), table_name="job")
    op.drop_index(op.f("ix_job_position"), table_name="job")
    op.drop_column("campaign", "frames")
    op.drop_column("campaign", "views")


def _frames(sequence: dict[str, Any]) -> int:
    """Return the number of frames of a fringe sequence: a uniform field has two, any other its steps."""
    steps = sequence.get("steps", 4)
    densities = sequence.get("densities", (32, 31, 30, 28, 24, 16))
    shown = sum(steps if density else 2 for density in densities)
    return shown * len(sequence.get("orientations_rad", (0, 1))) * len(sequence.get("exposures", (1,)))
