"""Give queue names room for the names of rigs."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

_COLUMNS = (
    ("job", "queue", "VARCHAR(16)", "VARCHAR(80)"),
    ("outbox", "queue", "VARCHAR(16)", "VARCHAR(80)"),
    ("queue", "name", "VARCHAR(16)", "VARCHAR(80)"),
    ("worker", "queues", "VARCHAR(128)", "TEXT"),
)


def upgrade() -> None:
    """Apply this step."""
    for table, column, before, after in _COLUMNS:
        _change(table, column, before, after)


def downgrade() -> None:
    """Take this step back."""
    for table, column, before, after in _COLUMNS:
        _change(table, column, after, before)


def _change(table: str, column: str, before: str, after: str) -> None:
    connection = op.get_bind()
    if connection.dialect.name != "sqlite":
        op.execute(f"ALTER TABLE {table} ALTER COLUMN {column} TYPE {after}")
        return
    # SQLite keeps texts of any length, so that only the words of the schema change; to copy a table that
    # others refer to would break their references. See "other kinds of table schema changes" in its manual.
    version = connection.scalar(sa.text("PRAGMA schema_version"))
    op.execute("PRAGMA writable_schema = ON")
    connection.execute(
        sa.text(
            "UPDATE sqlite_schema SET sql = replace(sql, :before, :after) "
            "WHERE type = 'table' AND name = :name"
        ),
        {"before": f"{column} {before} ", "after": f"{column} {after} ", "name": table},
    )
    op.execute(f"PRAGMA schema_version = {version + 1}")
    op.execute("PRAGMA writable_schema = OFF")
