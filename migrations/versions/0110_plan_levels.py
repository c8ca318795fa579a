"""Add the campaigns that are given one more state at each load that is held."""

import sqlalchemy as sa
from alembic import op

revision = "0110"
down_revision = "0109"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply this step."""
    op.create_table(
        "planned_levels",
        sa.Column("campaign_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("channel", sa.String(length=64), nullable=False),
        sa.Column("unit", sa.String(length=64), nullable=False),
        sa.Column("step", sa.Double(), nullable=False),
        sa.Column("tolerance", sa.Double(), nullable=False),
        sa.Column("for_s", sa.Double(), nullable=False),
        sa.Column("ask", sa.Boolean(), nullable=False),
        sa.Column("process", sa.Boolean(), nullable=False),
        sa.Column("look", sa.Boolean(), nullable=False),
        sa.Column("stop_if", sa.JSON(), nullable=False),
        sa.Column("held", sa.Boolean(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("last", sa.Double(), nullable=True),
        sa.Column("last_state_id", sa.Integer(), nullable=True),
        sa.Column("last_file_id", sa.BigInteger(), nullable=False),
        sa.Column("planned_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("planned_by", sa.String(length=80), nullable=False),
        sa.Column("seen", sa.Double(), nullable=True),
        sa.Column("seen_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("note", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name=op.f("fk_planned_levels_campaign_id_campaign")
        ),
        sa.ForeignKeyConstraint(
            ["last_state_id"], ["load_state.id"], name=op.f("fk_planned_levels_last_state_id_load_state")
        ),
        sa.PrimaryKeyConstraint("campaign_id", name=op.f("pk_planned_levels")),
    )


def downgrade() -> None:
    """Take this step back."""
    op.drop_table("planned_levels")
