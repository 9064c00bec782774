"""The `hilrig` command line: parses options and starts the services and tools."""
