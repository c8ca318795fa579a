"""Know of every file when it was recorded and what was read meanwhile, and keep planned loads apart."""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

# A result about a state is of the recordings of that state; what tells of several states, of all of them.
_BEHIND = """
CREATE TEMPORARY TABLE behind AS
WITH RECURSIVE found(file_id, state_id, measurement_id) AS (
    SELECT file.id, file.state_id, file.id
    FROM file JOIN measurement ON measurement.file_id = file.id
    UNION
    SELECT made.id, made.state_id, found.measurement_id
    FROM found
    JOIN provenance ON provenance.input_id = found.file_id
    JOIN file AS made ON made.id = provenance.output_id
    WHERE made.state_id IS NULL OR made.state_id = found.state_id
)
SELECT file_id, state_id, measurement_id FROM found
"""
_TIMES = """
CREATE TEMPORARY TABLE recorded AS
SELECT behind.file_id, max(measurement.recorded_at) AS begun_at
FROM behind JOIN measurement ON measurement.file_id = behind.measurement_id
GROUP BY behind.file_id
"""
_SET_TIMES = """
UPDATE file SET recorded_at = (SELECT recorded.begun_at FROM recorded WHERE recorded.file_id = file.id)
WHERE file.id IN (SELECT recorded.file_id FROM recorded)
"""
_READINGS_OF_MEASUREMENTS = """
INSERT INTO reading (file_id, name, value)
SELECT before.file_id, substr(before.name, 1, length(before.name) - 7), 0.5 * (before.value + after.value)
FROM statistic AS before
JOIN measurement ON measurement.file_id = before.file_id
JOIN statistic AS after ON after.file_id = before.file_id
    AND after.name = substr(before.name, 1, length(before.name) - 7) || '_after'
WHERE substr(before.name, length(before.name) - 6) = '_before'
"""
_READINGS_OF_RESULTS = """
INSERT INTO reading (file_id, name, value)
SELECT behind.file_id, reading.name, avg(reading.value)
FROM behind JOIN reading ON reading.file_id = behind.measurement_id
WHERE behind.state_id IS NOT NULL AND behind.file_id <> behind.measurement_id
GROUP BY behind.file_id, reading.name
"""
_FILLED = (
    _BEHIND,
    _TIMES,
    "CREATE INDEX ix_recorded ON recorded (file_id)",
    _SET_TIMES,
    _READINGS_OF_MEASUREMENTS,
    _READINGS_OF_RESULTS,
    "DROP TABLE recorded",
    "DROP TABLE behind",
)


def upgrade() -> None:
    """Apply this step."""
    file_id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
    op.create_table(
        "reading",
        sa.Column("file_id", file_id, nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("value", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_reading_file_id_file")),
        sa.PrimaryKeyConstraint("file_id", "name", name=op.f("pk_reading")),
    )
    op.add_column("file", sa.Column("recorded_at", sa.DateTime(timezone=True), nullable=True))
    for name in ("planned_load_n", "planned_displacement_mm"):
        op.add_column("load_state", sa.Column(name, sa.Double(), nullable=True))
    # What readings replaced is not told apart any more from what was planned.
    op.execute("UPDATE load_state SET planned_load_n = load_n, planned_displacement_mm = displacement_mm")
    for statement in _FILLED:
        op.execute(statement)
    op.create_index(op.f("ix_reading_name_value_file_id"), "reading", ["name", "value", "file_id"])
    op.create_index(op.f("ix_file_recorded_at"), "file", ["recorded_at"])
    op.create_index(op.f("ix_load_state_planned_load_n"), "load_state", ["planned_load_n"])


def downgrade() -> None:
    """Take this step back."""
    op.drop_index(op.f("ix_load_state_planned_load_n"), "load_state")
    op.drop_index(op.f("ix_file_recorded_at"), "file")
    for name in ("planned_displacement_mm", "planned_load_n"):
        op.drop_column("load_state", name)
    op.drop_column("file", "recorded_at")
    op.drop_table("reading")
