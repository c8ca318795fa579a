"""Hold devices for jobs and people, claim in the order of an index, and look back on jobs of a kind."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    # Nobody has held a device before.
    op.drop_table("lock")
    op.create_table(
        "lock",
        sa.Column("device", sa.String(length=128), nullable=False),
        sa.Column("job_id", sa.String(length=16), nullable=True),
        sa.Column("fence", sa.Integer(), nullable=True),
        sa.Column("holder", sa.String(length=128), nullable=True),
        sa.Column("lease_until", sa.DateTime(timezone=True), nullable=True),
        sa.Column("taken_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_lock_job_id_job")),
        sa.PrimaryKeyConstraint("device", name=op.f("pk_lock")),
    )
    op.create_index(op.f("ix_lock_job_id"), "lock", ["job_id"])
    op.create_table(
        "job_device",
        sa.Column("job_id", sa.String(length=16), nullable=False),
        sa.Column("device", sa.String(length=128), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_job_device_job_id_job")),
        sa.PrimaryKeyConstraint("job_id", "device", name=op.f("pk_job_device")),
    )
    op.drop_index(op.f("ix_job_state_queue_priority_position"), "job")
    op.create_index("ix_job_next", "job", ["state", sa.text("priority DESC"), "position", "queue"])
    op.create_index(op.f("ix_job_kind_finished_at"), "job", ["kind", "finished_at"])


def downgrade() -> None:
    """Take this step back."""
    op.drop_index(op.f("ix_job_kind_finished_at"), "job")
    op.drop_index("ix_job_next", "job")
    op.create_index(
        op.f("ix_job_state_queue_priority_position"), "job", ["state", "queue", "priority", "position"]
    )
    op.drop_table("job_device")
    op.drop_table("lock")
    op.create_table(
        "lock",
        sa.Column("device", sa.String(length=128), nullable=False),
        sa.Column("job_id", sa.String(length=16), nullable=False),
        sa.Column("fence", sa.Integer(), nullable=False),
        sa.Column("taken_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_lock_job_id_job")),
        sa.PrimaryKeyConstraint("device", name=op.f("pk_lock")),
    )
    op.create_index(op.f("ix_lock_job_id"), "lock", ["job_id"])
