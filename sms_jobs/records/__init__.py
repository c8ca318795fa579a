"""Frozen dataclasses that travel between jobs and are stored, every array with its axes and unit.

A field declared with `array(...)` becomes a dataset of the archive; every other field is plain data and
is stored as JSON. Declaring a record is therefore all that is needed to archive it.
"""
