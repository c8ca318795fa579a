"""A home and its service."""
