"""Use a calibration where somebody accepted it, and let each know its own sensors.

Nobody has accepted those that are there: `sms calibration accept` does.
"""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

_CALIBRATION = sa.table("calibration", sa.column("id"), sa.column("rig_id"), sa.column("sensors", sa.JSON))
_SENSOR = sa.table("sensor", *(sa.column(n) for n in ("id", "rig_id", "name", "role", "columns", "rows")))


def upgrade() -> None:
    """Apply this step."""
    op.create_table(
        "acceptance",
        sa.Column("calibration_id", sa.Integer(), nullable=False),
        sa.Column("campaign", sa.String(64), nullable=False),
        sa.Column("in_use", sa.Boolean(), nullable=False),
        sa.Column("decided_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("file_id", sa.BigInteger().with_variant(sa.Integer(), "sqlite"), nullable=False),
        sa.ForeignKeyConstraint(
            ["calibration_id"], ["calibration.id"], name=op.f("fk_acceptance_calibration_id_calibration")
        ),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_acceptance_file_id_file")),
        sa.PrimaryKeyConstraint("calibration_id", "campaign", name=op.f("pk_acceptance")),
        sa.UniqueConstraint("file_id", name=op.f("uq_acceptance_file_id")),
    )
    op.create_index(op.f("ix_acceptance_campaign"), "acceptance", ["campaign"])
    op.add_column("calibration", sa.Column("sensors", sa.JSON(), nullable=False, server_default="{}"))
    connection = op.get_bind()
    sensors: dict[int, dict[str, dict[str, object]]] = {}
    for row in connection.execute(sa.select(_SENSOR).order_by(_SENSOR.c.id)).mappings():
        each = {key: row[key] for key in ("role", "columns", "rows")}
        sensors.setdefault(row["rig_id"], {})[row["name"]] = each
    for rig_id, known in sensors.items():
        connection.execute(
            sa.update(_CALIBRATION).where(_CALIBRATION.c.rig_id == rig_id).values(sensors=known)
        )
    op.drop_table("sensor")


def downgrade() -> None:
    """Take this step back."""
    op.create_table(
        "sensor",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("rig_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(8), nullable=False),
        sa.Column("role", sa.String(16), nullable=False),
        sa.Column("columns", sa.Integer(), nullable=False),
        sa.Column("rows", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["rig_id"], ["rig.id"], name=op.f("fk_sensor_rig_id_rig")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_sensor")),
        sa.UniqueConstraint("rig_id", "name", name=op.f("uq_sensor_rig_id_name")),
    )
    connection = op.get_bind()
    entered: set[tuple[int, str]] = set()
    for row in connection.execute(sa.select(_CALIBRATION).order_by(_CALIBRATION.c.id)).mappings():
        for name, each in row["sensors"].items():
            if (row["rig_id"], name) not in entered:
                entered.add((row["rig_id"], name))
                values = {"id": len(entered), "rig_id": row["rig_id"], "name": name, **each}
                connection.execute(sa.insert(_SENSOR).values(values))
    op.drop_column("calibration", "sensors")
    op.drop_table("acceptance")
