"""The catalogue's schema, step by step (Alembic)."""

if __name__ != "sms_jobs.migrations":
    raise ImportError(f"'{__name__}' is not to be imported by this name: import sms_jobs.migrations instead")
