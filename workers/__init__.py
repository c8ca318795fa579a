"""The only home of Celery: messages, the supervisor, and the publisher."""

if __name__ != "sms_jobs.workers":
    # Two names for one module would be two Celery applications, each with half of the tasks.
    raise ImportError(f"'{__name__}' is not to be imported by this name: import sms_jobs.workers instead")
