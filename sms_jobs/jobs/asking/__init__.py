"""Answers questions about jobs, runs and campaigns."""
