"""Calibration sessions of exact geometry and noise."""
