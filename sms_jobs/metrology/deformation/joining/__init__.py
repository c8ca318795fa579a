"""Several views and cameras brought together into one surface."""
