"""The archive and its files: found, read, packed and verified."""
