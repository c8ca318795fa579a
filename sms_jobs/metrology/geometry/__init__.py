"""Cameras, rays, triangulation and rigid transforms."""
