"""Drivers: requests with time limits and retries, and what the states of devices mean."""
