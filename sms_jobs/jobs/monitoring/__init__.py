"""What a monitoring system sees: health, numbers, events."""
