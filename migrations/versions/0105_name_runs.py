"""Add the runs that submissions are named for."""

import sqlalchemy as sa
from alembic import op

revision = "0105"
down_revision = "0104"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    op.create_table(
        "run",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("created_by", sa.String(length=80), nullable=False),
        sa.Column("kept_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_run")),
        sa.UniqueConstraint("name", name=op.f("uq_run_name")),
    )
    op.create_table(
        "run_submission",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("submitted_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("submitted_by", sa.String(length=80), nullable=False),
        sa.Column("asked", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name=op.f("fk_run_submission_campaign_id_campaign")
        ),
        sa.ForeignKeyConstraint(["run_id"], ["run.id"], name=op.f("fk_run_submission_run_id_run")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_run_submission")),
    )
    op.create_index(op.f("ix_run_submission_run_id"), "run_submission", ["run_id"])
    op.create_table(
        "run_job",
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=16), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_run_job_job_id_job")),
        sa.ForeignKeyConstraint(["run_id"], ["run.id"], name=op.f("fk_run_job_run_id_run")),
        sa.PrimaryKeyConstraint("run_id", "job_id", name=op.f("pk_run_job")),
    )
    op.create_index(op.f("ix_run_job_job_id"), "run_job", ["job_id"])


def downgrade() -> None:
    """Take this step back."""
    op.drop_index(op.f("ix_run_job_job_id"), table_name="run_job")
    op.drop_table("run_job")
    op.drop_index(op.f("ix_run_submission_run_id"), table_name="run_submission")
    op.drop_table("run_submission")
    op.drop_table("run")
