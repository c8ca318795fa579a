"""Submits jobs at their times."""
