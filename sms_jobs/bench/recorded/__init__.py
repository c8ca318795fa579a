"""Test days on simulated rigs, and services that are killed meanwhile."""
