"""Decides which earlier results still hold: reused, replaced, or stale."""
