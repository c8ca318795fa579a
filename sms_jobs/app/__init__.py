"""The use cases: what a person or a program can ask of a home, one function each.

The first argument is the `Services` of a home, the others and the result are plain values and frozen
dataclasses. A use case prints nothing and asks nobody; how far it has come it tells a function. Its errors
are those of `sms_jobs.errors`.
"""
