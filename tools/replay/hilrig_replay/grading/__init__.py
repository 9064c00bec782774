"""Grading of recordings by the task of a lab."""
