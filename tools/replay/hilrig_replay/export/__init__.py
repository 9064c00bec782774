"""Recordings exported for other tools, and played back on the bus."""
