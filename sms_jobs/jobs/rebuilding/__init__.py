"""Rebuilds the catalogue from the files of the archive."""
