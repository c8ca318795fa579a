"""Bringing in what was measured elsewhere: frames, images, boards, points, readings and surfaces.

Where something has to be guessed, one function says what the files are taken for, and another enters them.
"""
