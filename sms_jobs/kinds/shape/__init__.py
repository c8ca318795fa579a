"""Job kinds that measure surfaces, and what is done with a surface alone."""
