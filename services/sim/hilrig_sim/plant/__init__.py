"""Simulated plant: arm, hard stops, limit flags, and the scene with its parts."""
