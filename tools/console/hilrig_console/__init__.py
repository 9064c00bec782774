"""Web console: a read-only live view of a lab for browsers."""
