"""Serial devices that are simulated behind their bytes, with faults on purpose."""
