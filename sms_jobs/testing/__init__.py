"""Job kinds run on records at hand, without an archive: for tests and benchmarks."""
