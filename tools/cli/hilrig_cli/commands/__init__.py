"""One module per command or command group: its options, its help text, and the call of its implementation."""
