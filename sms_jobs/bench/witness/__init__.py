"""Scenes that other renderers show, and what is true of them."""
