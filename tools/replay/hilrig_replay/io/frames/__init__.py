"""Rows of a recording as tables of other libraries."""
