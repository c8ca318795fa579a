"""Count the jobs of a campaign or submission by an index that holds all that is asked."""

from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    op.create_index(
        op.f("ix_job_campaign_id_state_submitted_at"), "job", ["campaign_id", "state", "submitted_at"]
    )


def downgrade() -> None:
    """Take this step back."""
    op.drop_index(op.f("ix_job_campaign_id_state_submitted_at"), "job")
