"""Service processes: startup, discovery, health reports, logging and shutdown."""
