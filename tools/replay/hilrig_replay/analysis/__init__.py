"""Measurements on recordings: latency, data quality, verification and comparison."""
