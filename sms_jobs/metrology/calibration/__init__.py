"""Calibration: first guesses, bundle adjustment, and checks of the result."""
