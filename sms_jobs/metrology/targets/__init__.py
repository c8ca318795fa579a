"""Calibration targets: what boards and spheres look like in images and clouds, and where they are."""
