"""Classroom: roster, assignments, grades and gradebooks of a class. Reads recordings only; no service needs it."""
