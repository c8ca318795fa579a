"""Hostile input for every command, made from what the commands say of themselves, and what came of it.

`tries` makes command lines out of the table of commands, `values` and `things` what stands in them, `store`
the homes that they work on; `trial` runs them in forked processes, and `judge` says what must never happen.
"""
