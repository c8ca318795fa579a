"""Fringes and returns with exact truth."""
