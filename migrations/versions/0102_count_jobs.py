"""Count the jobs of each campaign, kind, queue and state, by triggers in the transaction that changes a job.

Whoever makes the table `job` anew makes its triggers anew too: they go with it.
"""

import sqlalchemy as sa
from alembic import op

revision = "0102"
down_revision = "0101"
branch_labels = None
depends_on = None

_KEY = ("campaign_id", "kind", "queue", "state")
_COLUMNS = ", ".join(_KEY)


def upgrade() -> None:
    """Apply this step."""
    op.create_table(
        "job_count",
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("queue", sa.String(length=80), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("part", sa.BigInteger(), nullable=False),
        sa.Column("jobs", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint(*_KEY, "part", name=op.f("pk_job_count")),
    )
    for statement in _sqlite() if op.get_bind().dialect.name == "sqlite" else _postgresql():
        op.execute(statement)
    # After the triggers, which let nobody change a job until this is committed.
    op.execute(
        f"INSERT INTO job_count ({_COLUMNS}, part, jobs) "  # noqa: S608 - of constants alone
        f"SELECT {_COLUMNS}, 0, count(*) FROM job GROUP BY {_COLUMNS}"
    )


def downgrade() -> None:
    """Take this step back."""
    table = "" if op.get_bind().dialect.name == "sqlite" else " ON job"
    for change in ("added", "changed", "removed"):
        op.execute(f"DROP TRIGGER job_count_{change}{table}")
    if table:
        op.execute("DROP FUNCTION count_job()")
    op.drop_table("job_count")


def _row(row: str) -> str:
    return ", ".join(f"{row}.{name}" for name in _KEY)


def _differ(operator: str) -> str:
    return " OR ".join(f"OLD.{name} {operator} NEW.{name}" for name in _KEY)


def _sqlite() -> list[str]:
    # One at a time writes, so a single part is enough; a row that has come to nothing goes.
    def add(row: str, number: int) -> str:
        return (
            f"INSERT INTO job_count ({_COLUMNS}, part, jobs) VALUES ({_row(row)}, 0, {number}) "  # noqa: S608
            f"ON CONFLICT ({_COLUMNS}, part) DO UPDATE SET jobs = jobs + excluded.jobs;"
        )

    of_old = " AND ".join(f"{name} = OLD.{name}" for name in _KEY)
    take = f"{add('OLD', -1)} DELETE FROM job_count WHERE {of_old} AND part = 0 AND jobs = 0;"  # noqa: S608
    return [
        f"CREATE TRIGGER job_count_added AFTER INSERT ON job BEGIN {add('NEW', 1)} END",
        (
            f"CREATE TRIGGER job_count_changed AFTER UPDATE OF {_COLUMNS} ON job WHEN {_differ('IS NOT')} "
            f"BEGIN {take} {add('NEW', 1)} END"
        ),
        f"CREATE TRIGGER job_count_removed AFTER DELETE ON job BEGIN {take} END",
    ]


def _postgresql() -> list[str]:
    # Each change adds rows of its own, so that nobody waits for a row that another changes;
    # `catalogue.job_counts.fold` adds them up.
    def add(row: str, number: int) -> str:
        return (
            f"INSERT INTO job_count ({_COLUMNS}, part, jobs) "  # noqa: S608 - of constants alone
            f"VALUES ({_row(row)}, nextval('job_count_part'), {number});"
        )

    each = "FOR EACH ROW {when} EXECUTE FUNCTION count_job()"
    return [
        "CREATE SEQUENCE job_count_part OWNED BY job_count.part",
        (
            "CREATE OR REPLACE FUNCTION count_job() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
            f"IF TG_OP <> 'INSERT' THEN {add('OLD', -1)} END IF; "
            f"IF TG_OP <> 'DELETE' THEN {add('NEW', 1)} END IF; "
            "RETURN NULL; END $$"
        ),
        f"CREATE TRIGGER job_count_added AFTER INSERT ON job {each.format(when='')}",
        (
            f"CREATE TRIGGER job_count_changed AFTER UPDATE OF {_COLUMNS} ON job "
            f"{each.format(when='WHEN (' + _differ('IS DISTINCT FROM') + ')')}"
        ),
        f"CREATE TRIGGER job_count_removed AFTER DELETE ON job {each.format(when='')}",
    ]
