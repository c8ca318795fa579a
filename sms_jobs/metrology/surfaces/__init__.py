"""Meshes from organised point clouds."""
