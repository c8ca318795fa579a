"""The kinds that record with instruments, by name: to import the kinds themselves loads the instruments."""

from __future__ import annotations

ACQUIRE = "acquire"
RECORDING = (ACQUIRE, "stream")
"""A test compares them with the kinds."""
