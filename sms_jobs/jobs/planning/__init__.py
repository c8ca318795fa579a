"""Turns a request into a graph of jobs, submits it, and estimates how long it takes."""
