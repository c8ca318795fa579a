"""Folders that carry a campaign from one archive to another."""
