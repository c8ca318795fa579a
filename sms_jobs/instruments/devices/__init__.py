"""Devices as recipes use them, whichever protocol they speak."""
