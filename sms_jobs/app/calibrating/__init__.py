"""Calibrations of rigs, and tests of measuring systems."""
