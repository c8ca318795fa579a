"""Tables of the catalogue beside those of jobs and files."""
