"""Protocols as pure functions and decoders: values to bytes and back, without any wire."""
