"""Recordings with instruments: planned, started, looked at, and picked up again."""
