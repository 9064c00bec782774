"""One module a command (or a close family of commands): its options, its help, and the wiring to what does the work."""
