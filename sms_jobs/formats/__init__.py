"""Configuration files, imports and exports: where units of the outside world are converted."""
