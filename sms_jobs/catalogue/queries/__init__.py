"""Queries of files and load states: language, names and SQL."""
