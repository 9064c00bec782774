"""Labs on the local machine: supervision of their processes, and the demo."""
