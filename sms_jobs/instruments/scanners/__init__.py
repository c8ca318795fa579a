"""Scanners with a computer of their own: a server in each, and a client that lets them record together."""
