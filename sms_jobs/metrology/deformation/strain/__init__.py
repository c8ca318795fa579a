"""Strain of the measured surface, over gauge discs and between points."""
