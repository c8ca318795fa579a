"""Pairs of images of one camera with exact truth."""
