"""Create the catalogue."""

import sqlalchemy as sa
from alembic import op

revision = "0100"
down_revision = None
branch_labels = None
depends_on = None

_BIG_ID = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    """Apply this step."""
    op.create_table(
        "queue",
        sa.Column("name", sa.String(length=80), nullable=False),
        sa.Column("paused_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("for_room", sa.Boolean(), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_queue")),
    )
    op.create_table(
        "rig",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_rig")),
        sa.UniqueConstraint("name", name=op.f("uq_rig_name")),
    )
    op.create_table(
        "saved_query",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("saved_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_saved_query")),
        sa.UniqueConstraint("name", name=op.f("uq_saved_query_name")),
    )
    op.create_table(
        "schedule",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("expression", sa.String(length=128), nullable=False),
        sa.Column("time_zone", sa.String(length=64), nullable=False),
        sa.Column("request", sa.JSON(), nullable=False),
        sa.Column("missed_fire", sa.String(length=16), nullable=False),
        sa.Column("grace_s", sa.Double(), nullable=False),
        sa.Column("paused", sa.Boolean(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_schedule")),
        sa.UniqueConstraint("name", name=op.f("uq_schedule_name")),
    )
    op.create_table(
        "specimen",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("material", sa.Text(), nullable=False),
        sa.Column("description", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_specimen")),
        sa.UniqueConstraint("name", name=op.f("uq_specimen_name")),
    )
    op.create_table(
        "worker",
        sa.Column("id", sa.String(length=16), nullable=False),
        sa.Column("host", sa.String(length=128), nullable=False),
        sa.Column("pid", sa.Integer(), nullable=False),
        sa.Column("machine", sa.String(length=64), nullable=False),
        sa.Column("boot", sa.String(length=64), nullable=False),
        sa.Column("pid_namespace", sa.String(length=64), nullable=False),
        sa.Column("process_started", sa.BigInteger(), nullable=False),
        sa.Column("queues", sa.Text(), nullable=False),
        sa.Column("concurrency", sa.Integer(), nullable=False),
        sa.Column("processes", sa.Integer(), nullable=False),
        sa.Column("lease_s", sa.Double(), nullable=False),
        sa.Column("beats", sa.BigInteger(), nullable=False),
        sa.Column("given_up", sa.Boolean(), nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("beat_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("draining", sa.Boolean(), nullable=False),
        sa.Column("held_for", sa.Text(), nullable=True),
        sa.Column("held_at", sa.String(length=200), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_worker")),
    )
    op.create_table(
        "campaign",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("specimen_id", sa.Integer(), nullable=False),
        sa.Column("rig_id", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("definition", sa.JSON(), nullable=False),
        sa.Column("definition_hash", sa.String(length=64), nullable=False),
        sa.Column("plan", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(["rig_id"], ["rig.id"], name=op.f("fk_campaign_rig_id_rig")),
        sa.ForeignKeyConstraint(
            ["specimen_id"], ["specimen.id"], name=op.f("fk_campaign_specimen_id_specimen")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_campaign")),
        sa.UniqueConstraint("name", name=op.f("uq_campaign_name")),
    )
    op.create_index(op.f("ix_campaign_rig_id"), "campaign", ["rig_id"])
    op.create_index(op.f("ix_campaign_specimen_id"), "campaign", ["specimen_id"])
    op.create_table(
        "schedule_fire",
        sa.Column("schedule_id", sa.Integer(), nullable=False),
        sa.Column("fire_time", sa.DateTime(timezone=True), nullable=False),
        sa.Column("outcome", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(
            ["schedule_id"], ["schedule.id"], name=op.f("fk_schedule_fire_schedule_id_schedule")
        ),
        sa.PrimaryKeyConstraint("schedule_id", "fire_time", name=op.f("pk_schedule_fire")),
    )
    op.create_table(
        "job",
        sa.Column("id", sa.String(length=16), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("kind_version", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("subject", sa.String(length=200), nullable=False),
        sa.Column("parameters", sa.JSON(), nullable=False),
        sa.Column("queue", sa.String(length=80), nullable=False),
        sa.Column("priority", sa.Integer(), nullable=False),
        sa.Column("position", sa.BigInteger(), nullable=False),
        sa.Column("repeatable", sa.Boolean(), nullable=False),
        sa.Column("use_cache", sa.Boolean(), nullable=False),
        sa.Column(
            "state",
            sa.Enum(
                "waiting",
                "queued",
                "running",
                "succeeded",
                "failed",
                "skipped",
                "cancelled",
                "lost",
                "quarantined",
                "needs-operator",
                name="job_state",
                native_enum=False,
                length=16,
            ),
            nullable=False,
        ),
        sa.Column("submitted_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("finished_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("crashes", sa.Integer(), nullable=False),
        sa.Column("tries", sa.Integer(), nullable=False),
        sa.Column("fence", sa.Integer(), nullable=False),
        sa.Column("worker_id", sa.String(length=16), nullable=True),
        sa.Column("pid", sa.Integer(), nullable=True),
        sa.Column("stop_asked_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column(
            "stop_as",
            sa.Enum(
                "waiting",
                "queued",
                "running",
                "succeeded",
                "failed",
                "skipped",
                "cancelled",
                "lost",
                "quarantined",
                "needs-operator",
                name="job_state",
                native_enum=False,
                length=16,
            ),
            nullable=True,
        ),
        sa.Column("stop_reason", sa.Text(), nullable=True),
        sa.Column("progress", sa.Double(), nullable=False),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("reuse_key", sa.String(length=64), nullable=True),
        sa.Column("reused_from", sa.String(length=16), nullable=True),
        sa.ForeignKeyConstraint(["campaign_id"], ["campaign.id"], name=op.f("fk_job_campaign_id_campaign")),
        sa.ForeignKeyConstraint(["reused_from"], ["job.id"], name=op.f("fk_job_reused_from_job")),
        sa.ForeignKeyConstraint(["worker_id"], ["worker.id"], name=op.f("fk_job_worker_id_worker")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_job")),
    )
    op.create_index("ix_job_next", "job", ["state", sa.text("priority DESC"), "position", "queue"])
    op.create_index(op.f("ix_job_campaign_id_position"), "job", ["campaign_id", "position"])
    op.create_index(
        op.f("ix_job_campaign_id_state_submitted_at"),
        "job",
        ["campaign_id", "state", "submitted_at"],
        unique=False,
    )
    op.create_index(op.f("ix_job_kind_finished_at"), "job", ["kind", "finished_at"])
    op.create_index(op.f("ix_job_reuse_key_state"), "job", ["reuse_key", "state"])
    op.create_index(op.f("ix_job_subject"), "job", ["subject"])
    op.create_index(op.f("ix_job_worker_id_state"), "job", ["worker_id", "state"])
    op.create_table(
        "load_state",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("label", sa.String(length=64), nullable=False),
        sa.Column("position", sa.Integer(), nullable=False),
        sa.Column("load_n", sa.Double(), nullable=True),
        sa.Column("displacement_mm", sa.Double(), nullable=True),
        sa.Column("planned_load_n", sa.Double(), nullable=True),
        sa.Column("planned_displacement_mm", sa.Double(), nullable=True),
        sa.Column("time", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(
            ["campaign_id"], ["campaign.id"], name=op.f("fk_load_state_campaign_id_campaign")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_load_state")),
        sa.UniqueConstraint("campaign_id", "label", name=op.f("uq_load_state_campaign_id_label")),
    )
    op.create_index(op.f("ix_load_state_label"), "load_state", ["label"])
    op.create_index(op.f("ix_load_state_load_n"), "load_state", ["load_n"])
    op.create_index(op.f("ix_load_state_planned_load_n"), "load_state", ["planned_load_n"])
    op.create_index(op.f("ix_load_state_time"), "load_state", ["time"])
    op.create_table(
        "channel",
        sa.Column("state_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("value", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(["state_id"], ["load_state.id"], name=op.f("fk_channel_state_id_load_state")),
        sa.PrimaryKeyConstraint("state_id", "name", name=op.f("pk_channel")),
    )
    op.create_index(op.f("ix_channel_name_value"), "channel", ["name", "value"])
    op.create_table(
        "event",
        sa.Column("id", _BIG_ID, nullable=False),
        sa.Column("job_id", sa.String(length=16), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.Column(
            "state",
            sa.Enum(
                "waiting",
                "queued",
                "running",
                "succeeded",
                "failed",
                "skipped",
                "cancelled",
                "lost",
                "quarantined",
                "needs-operator",
                name="job_state",
                native_enum=False,
                length=16,
            ),
            nullable=False,
        ),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("message", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_event_job_id_job")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_event")),
    )
    op.create_index(op.f("ix_event_job_id_id"), "event", ["job_id", "id"])
    op.create_table(
        "file",
        sa.Column("id", _BIG_ID, nullable=False),
        sa.Column("source", sa.String(length=32), nullable=False),
        sa.Column("path", sa.Text(), nullable=False),
        sa.Column("content_hash", sa.String(length=64), nullable=False),
        sa.Column("size_bytes", sa.BigInteger(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("media_type", sa.String(length=64), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("recorded_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("campaign_id", sa.Integer(), nullable=True),
        sa.Column("state_id", sa.Integer(), nullable=True),
        sa.Column("view", sa.String(length=16), nullable=True),
        sa.Column("camera", sa.String(length=8), nullable=True),
        sa.Column("projector", sa.String(length=8), nullable=True),
        sa.Column("job_id", sa.String(length=16), nullable=True),
        sa.ForeignKeyConstraint(["campaign_id"], ["campaign.id"], name=op.f("fk_file_campaign_id_campaign")),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_file_job_id_job")),
        sa.ForeignKeyConstraint(["state_id"], ["load_state.id"], name=op.f("fk_file_state_id_load_state")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_file")),
        sa.UniqueConstraint("path", name=op.f("uq_file_path")),
    )
    op.create_index(
        op.f("ix_file_campaign_id_source_id"), "file", ["campaign_id", "source", "id"], unique=False
    )
    op.create_index(
        op.f("ix_file_campaign_id_source_state_id_view_id"),
        "file",
        ["campaign_id", "source", "state_id", "view", "id"],
        unique=False,
    )
    op.create_index(op.f("ix_file_created_at"), "file", ["created_at"])
    op.create_index(op.f("ix_file_job_id"), "file", ["job_id"])
    op.create_index(op.f("ix_file_recorded_at"), "file", ["recorded_at"])
    op.create_index(op.f("ix_file_source_id"), "file", ["source", "id"])
    op.create_index(op.f("ix_file_state_id"), "file", ["state_id"])
    op.create_table(
        "job_device",
        sa.Column("job_id", sa.String(length=16), nullable=False),
        sa.Column("device", sa.String(length=128), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_job_device_job_id_job")),
        sa.PrimaryKeyConstraint("job_id", "device", name=op.f("pk_job_device")),
    )
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
        "outbox",
        sa.Column("id", _BIG_ID, nullable=False),
        sa.Column("job_id", sa.String(length=16), nullable=False),
        sa.Column("queue", sa.String(length=80), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_outbox_job_id_job")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_outbox")),
    )
    op.create_table(
        "calibration",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("rig_id", sa.Integer(), nullable=False),
        sa.Column("file_id", _BIG_ID, nullable=False),
        sa.Column("valid_from", sa.DateTime(timezone=True), nullable=False),
        sa.Column("origin", sa.Text(), nullable=False),
        sa.Column("sensors", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_calibration_file_id_file")),
        sa.ForeignKeyConstraint(["rig_id"], ["rig.id"], name=op.f("fk_calibration_rig_id_rig")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_calibration")),
        sa.UniqueConstraint("file_id", name=op.f("uq_calibration_file_id")),
    )
    op.create_index(
        op.f("ix_calibration_rig_id_valid_from"), "calibration", ["rig_id", "valid_from"], unique=False
    )
    op.create_table(
        "dependency",
        sa.Column("job_id", sa.String(length=16), nullable=False),
        sa.Column("role", sa.String(length=256), nullable=False),
        sa.Column("source", sa.String(length=32), nullable=False),
        sa.Column("subject", sa.String(length=200), nullable=False),
        sa.Column("producer_id", sa.String(length=16), nullable=True),
        sa.Column("file_id", _BIG_ID, nullable=True),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_dependency_file_id_file")),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_dependency_job_id_job")),
        sa.ForeignKeyConstraint(["producer_id"], ["job.id"], name=op.f("fk_dependency_producer_id_job")),
        sa.PrimaryKeyConstraint("job_id", "role", name=op.f("pk_dependency")),
    )
    op.create_index(op.f("ix_dependency_file_id"), "dependency", ["file_id"])
    op.create_index(op.f("ix_dependency_producer_id"), "dependency", ["producer_id"])
    op.create_table(
        "measurement",
        sa.Column("file_id", _BIG_ID, nullable=False),
        sa.Column("state_id", sa.Integer(), nullable=False),
        sa.Column("view", sa.String(length=16), nullable=False),
        sa.Column("recorded_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_measurement_file_id_file")),
        sa.ForeignKeyConstraint(
            ["state_id"], ["load_state.id"], name=op.f("fk_measurement_state_id_load_state")
        ),
        sa.PrimaryKeyConstraint("file_id", name=op.f("pk_measurement")),
    )
    op.create_index(op.f("ix_measurement_recorded_at"), "measurement", ["recorded_at"])
    op.create_index(
        op.f("ix_measurement_state_id_view_recorded_at"),
        "measurement",
        ["state_id", "view", "recorded_at"],
        unique=False,
    )
    op.create_table(
        "pin",
        sa.Column("file_id", _BIG_ID, nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("pinned_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_pin_file_id_file")),
        sa.PrimaryKeyConstraint("file_id", name=op.f("pk_pin")),
    )
    op.create_table(
        "provenance",
        sa.Column("output_id", _BIG_ID, nullable=False),
        sa.Column("role", sa.String(length=256), nullable=False),
        sa.Column("input_id", _BIG_ID, nullable=False),
        sa.ForeignKeyConstraint(["input_id"], ["file.id"], name=op.f("fk_provenance_input_id_file")),
        sa.ForeignKeyConstraint(["output_id"], ["file.id"], name=op.f("fk_provenance_output_id_file")),
        sa.PrimaryKeyConstraint("output_id", "role", name=op.f("pk_provenance")),
    )
    op.create_index(op.f("ix_provenance_input_id"), "provenance", ["input_id"])
    op.create_table(
        "reading",
        sa.Column("file_id", _BIG_ID, nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("value", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_reading_file_id_file")),
        sa.PrimaryKeyConstraint("file_id", "name", name=op.f("pk_reading")),
    )
    op.create_index(
        op.f("ix_reading_name_value_file_id"), "reading", ["name", "value", "file_id"], unique=False
    )
    op.create_table(
        "result",
        sa.Column("file_id", _BIG_ID, nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("kind_version", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_result_file_id_file")),
        sa.PrimaryKeyConstraint("file_id", name=op.f("pk_result")),
    )
    op.create_index(op.f("ix_result_kind"), "result", ["kind"])
    op.create_table(
        "statistic",
        sa.Column("file_id", _BIG_ID, nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("value", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_statistic_file_id_file")),
        sa.PrimaryKeyConstraint("file_id", "name", name=op.f("pk_statistic")),
    )
    op.create_index(
        op.f("ix_statistic_name_value_file_id"), "statistic", ["name", "value", "file_id"], unique=False
    )
    op.create_table(
        "acceptance",
        sa.Column("calibration_id", sa.Integer(), nullable=False),
        sa.Column("campaign", sa.String(length=64), nullable=False),
        sa.Column("in_use", sa.Boolean(), nullable=False),
        sa.Column("decided_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("file_id", _BIG_ID, nullable=False),
        sa.ForeignKeyConstraint(
            ["calibration_id"], ["calibration.id"], name=op.f("fk_acceptance_calibration_id_calibration")
        ),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_acceptance_file_id_file")),
        sa.PrimaryKeyConstraint("calibration_id", "campaign", name=op.f("pk_acceptance")),
        sa.UniqueConstraint("file_id", name=op.f("uq_acceptance_file_id")),
    )
    op.create_index(op.f("ix_acceptance_campaign"), "acceptance", ["campaign"])
    op.create_table(
        "calibration_use",
        sa.Column("calibration_id", sa.Integer(), nullable=False),
        sa.Column("file_id", _BIG_ID, nullable=False),
        sa.ForeignKeyConstraint(
            ["calibration_id"], ["calibration.id"], name=op.f("fk_calibration_use_calibration_id_calibration")
        ),
        sa.ForeignKeyConstraint(["file_id"], ["file.id"], name=op.f("fk_calibration_use_file_id_file")),
        sa.PrimaryKeyConstraint("calibration_id", "file_id", name=op.f("pk_calibration_use")),
    )
    op.create_index(op.f("ix_calibration_use_file_id"), "calibration_use", ["file_id"])


def downgrade() -> None:
    """Take this step back."""
    for table in (
        "calibration_use",
        "acceptance",
        "statistic",
        "result",
        "reading",
        "provenance",
        "pin",
        "measurement",
        "dependency",
        "calibration",
        "outbox",
        "lock",
        "job_device",
        "file",
        "event",
        "channel",
        "load_state",
        "job",
        "schedule_fire",
        "campaign",
        "worker",
        "specimen",
        "schedule",
        "saved_query",
        "rig",
        "queue",
    ):
        op.drop_table(table)
