"""Recordings read as arrays: files, columns, time bases and the index of a folder."""
