"""Keeps the archive sound: verified, repaired, backed up, and cleared of what may go."""
