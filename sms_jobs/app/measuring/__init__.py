"""Recordings with the instruments of a rig."""
