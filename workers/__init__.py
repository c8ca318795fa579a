"""The only home of Celery: messages, the supervisor, and the publisher."""
