"""Jobs, runs, queues and schedules."""
