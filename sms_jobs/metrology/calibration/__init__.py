"""Calibration: first guesses, bundle adjustment, and what they are worth."""
