"""Simulation of the sampled control loop, faster than real time."""
