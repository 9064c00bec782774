"""Network impairment emulation: the random model, delay lines and schedules."""
