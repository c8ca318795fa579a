"""Recordings with instruments: planned, begun, looked at, and picked up again."""
