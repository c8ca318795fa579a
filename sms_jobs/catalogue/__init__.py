"""The database that indexes the archive and owns the state of every job."""
