"""Whether a calibration still holds, and what changed between two."""
