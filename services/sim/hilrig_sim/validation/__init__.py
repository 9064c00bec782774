"""Validation of the simulation against published results."""
