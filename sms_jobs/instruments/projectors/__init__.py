"""Projectors: one module a driver, found by the `DRIVER` that it declares."""
