"""Campaigns and the frames of their specimens."""
