"""Calibration of a pan-tilt stage."""
