"""The message bus: its interface, the zenoh and in-memory implementations, access rules."""
