"""Notifications: collected, queued, sent once."""
