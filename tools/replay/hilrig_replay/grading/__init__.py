"""Grading of recordings against a lab's task."""
