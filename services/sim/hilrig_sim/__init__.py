"""Simulation: a virtual SCARA arm per rig, stepped in real time."""
