"""Timing benchmark of this host: the measurement, its verdict, and CPU stress."""
