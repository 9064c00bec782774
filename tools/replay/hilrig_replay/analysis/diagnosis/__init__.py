"""Diagnosis of a run: timing causes, ranked by the share of the age that they explain, and control observations."""
