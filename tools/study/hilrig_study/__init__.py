"""Robustness studies of a control loop against delay, jitter and loss: theory, simulation and live measurements."""
