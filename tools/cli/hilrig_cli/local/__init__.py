"""Labs on this host: supervision of their processes, and the demo."""
