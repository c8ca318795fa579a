"""Stop running jobs for a reason, and pause queues."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

_STATES = (
    *("waiting", "queued", "running", "succeeded", "failed"),
    *("skipped", "cancelled", "lost", "quarantined", "needs-operator"),
)


def upgrade() -> None:
    """Apply this step."""
    op.create_table(
        "queue",
        sa.Column("name", sa.String(length=16), nullable=False),
        sa.Column("paused_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("for_room", sa.Boolean(), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_queue")),
    )
    with op.batch_alter_table("job") as job:
        job.add_column(sa.Column("stop_asked_at", sa.DateTime(timezone=True), nullable=True))
        job.add_column(
            sa.Column(
                "stop_as", sa.Enum(*_STATES, name="job_state", native_enum=False, length=16), nullable=True
            )
        )
        job.add_column(sa.Column("stop_reason", sa.Text(), nullable=True))
    # A job that was to be cancelled still is: since when is not known, so it is since it began.
    op.execute(
        "UPDATE job SET stop_asked_at = started_at, stop_as = 'cancelled', "
        "stop_reason = 'cancelled by an operator' WHERE cancel_requested"
    )
    with op.batch_alter_table("job") as job:
        job.drop_column("cancel_requested")


def downgrade() -> None:
    """Take this step back."""
    with op.batch_alter_table("job") as job:
        job.add_column(sa.Column("cancel_requested", sa.Boolean(), nullable=False, server_default=sa.false()))
    op.execute("UPDATE job SET cancel_requested = (stop_as IS NOT NULL AND stop_as = 'cancelled')")
    with op.batch_alter_table("job") as job:
        job.alter_column("cancel_requested", server_default=None)
        job.drop_column("stop_reason")
        job.drop_column("stop_as")
        job.drop_column("stop_asked_at")
    op.drop_table("queue")
