"""Measurements of the local machine: timing jitter and CPU load."""
