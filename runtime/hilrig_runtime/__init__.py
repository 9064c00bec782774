"""The common parts of all processes: configuration, bus, messaging, timing, security and service life cycle."""
