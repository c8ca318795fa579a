"""Fringe patterns, phase stepping and temporal unwrapping."""
