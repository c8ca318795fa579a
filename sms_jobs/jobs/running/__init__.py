"""Runs jobs: claims them, keeps them within their limits, and recovers those that were lost."""
