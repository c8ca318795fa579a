"""Displacement at every pixel, and what is made of it."""
