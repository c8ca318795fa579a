"""The rigs of this host, and who holds a device."""
