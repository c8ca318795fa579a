"""Add the recordings that are planned while a test goes on."""

import sqlalchemy as sa
from alembic import op

revision = "0104"
down_revision = "0103"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    op.create_table(
        "planned_recording",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("state_id", sa.Integer(), nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("trigger", sa.JSON(), nullable=False),
        sa.Column("ask", sa.Boolean(), nullable=False),
        sa.Column("process", sa.Boolean(), nullable=False),
        sa.Column("status", sa.String(length=16), nullable=False),
        sa.Column("held", sa.Boolean(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("planned_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("planned_by", sa.String(length=80), nullable=False),
        sa.Column("due_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("job_id", sa.String(length=16), nullable=True),
        sa.Column("seen", sa.Double(), nullable=True),
        sa.Column("seen_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("note", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name=op.f("fk_planned_recording_campaign_id_campaign")
        ),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_planned_recording_job_id_job")),
        sa.ForeignKeyConstraint(
            ["state_id"], ["load_state.id"], name=op.f("fk_planned_recording_state_id_load_state")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_planned_recording")),
        sa.UniqueConstraint("job_id", name=op.f("uq_planned_recording_job_id")),
        sa.UniqueConstraint("state_id", name=op.f("uq_planned_recording_state_id")),
    )
    op.create_index(op.f("ix_planned_recording_campaign_id"), "planned_recording", ["campaign_id"])
    op.create_index(op.f("ix_planned_recording_status"), "planned_recording", ["status"])


def downgrade() -> None:
    """Take this step back."""
    op.drop_index(op.f("ix_planned_recording_status"), table_name="planned_recording")
    op.drop_index(op.f("ix_planned_recording_campaign_id"), table_name="planned_recording")
    op.drop_table("planned_recording")
