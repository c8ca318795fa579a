"""Runs the migrations on the connection that `sms_jobs.catalogue.schema` hands over."""

from alembic import context

from sms_jobs.catalogue.tables.every import METADATA

connection = context.config.attributes["connection"]
context.configure(
    connection=connection,
    target_metadata=METADATA,
    compare_type=True,
    render_as_batch=connection.dialect.name == "sqlite",
)
context.run_migrations()
