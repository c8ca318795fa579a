"""Correlation of textures, displacement in three dimensions, merging and strain."""
