"""Reads recordings as arrays: files, columns and time bases."""
