"""The life of a service process: startup, discovery, health reports, logging and shutdown."""
