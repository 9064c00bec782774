"""Impairment of a rig's control loop: the random model, delay lines, schedules and their controller."""
