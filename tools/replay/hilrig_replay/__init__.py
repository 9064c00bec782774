"""Recordings read back: arrays, latency, pictures."""
