"""Answer questions to the archive by index, and keep those that are asked again."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

_USES = """
INSERT INTO calibration_use (calibration_id, file_id)
WITH RECURSIVE used(calibration_id, file_id) AS (
    SELECT calibration.id, provenance.output_id
    FROM calibration JOIN provenance ON provenance.input_id = calibration.file_id
    UNION
    SELECT used.calibration_id, provenance.output_id
    FROM used JOIN provenance ON provenance.input_id = used.file_id
)
SELECT calibration_id, file_id FROM used
"""

_NEW = [
    ("file", ["campaign_id", "source", "id"]),
    ("file", ["source", "id"]),
    ("load_state", ["label"]),
    ("load_state", ["time"]),
    ("measurement", ["recorded_at"]),
    ("statistic", ["name", "value", "file_id"]),
]


def upgrade() -> None:
    """Apply this step."""
    op.create_table(
        "saved_query",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("saved_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_saved_query")),
        sa.UniqueConstraint("name", name=op.f("uq_saved_query_name")),
    )
    file_id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
    op.create_table(
        "calibration_use",
        sa.Column("calibration_id", sa.Integer(), nullable=False),
        sa.Column("file_id", file_id, nullable=False),
        sa.ForeignKeyConstraint(
            ["calibration_id"], ["calibration.id"], name=op.f("fk_calibration_use_calibration_id_calibration")
        ),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_calibration_use_file_id_file")),
        sa.PrimaryKeyConstraint("calibration_id", "file_id", name=op.f("pk_calibration_use")),
    )
    op.create_index(op.f("ix_calibration_use_file_id"), "calibration_use", ["file_id"])
    op.execute(_USES)
    op.drop_index(op.f("ix_statistic_name_value"), "statistic")
    for table, columns in _NEW:
        op.create_index(op.f(f"ix_{table}_{'_'.join(columns)}"), table, columns)


def downgrade() -> None:
    """Take this step back."""
    for table, columns in reversed(_NEW):
        op.drop_index(op.f(f"ix_{table}_{'_'.join(columns)}"), table)
    op.create_index(op.f("ix_statistic_name_value"), "statistic", ["name", "value"])
    op.drop_table("calibration_use")
    op.drop_table("saved_query")
