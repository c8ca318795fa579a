"""Sealed, checksummed, self-describing HDF5 files."""
