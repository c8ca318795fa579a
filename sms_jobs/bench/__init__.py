"""Figures of speed and accuracy, and studies, that anyone can run again on any machine.

A module of `bench.groups` that has a `GROUP` is a group of figures, a module of `bench.studies` that has a
`STUDY` is a study; there is nothing else to register.
"""
