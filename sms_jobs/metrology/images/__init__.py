"""Interpolation, masks and the segmentation of images into continuous regions."""
