"""Measurements on recordings: latency, data quality, verification, comparison, and the index of a folder."""
