"""The control loop simulated in virtual time."""
