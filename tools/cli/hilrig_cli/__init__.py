"""The `hilrig` command: parses, wires and starts the others, nothing else."""
