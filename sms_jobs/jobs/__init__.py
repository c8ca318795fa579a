"""The life of a job: planned, queued, claimed, run, reused, recovered. Knows no Celery."""
