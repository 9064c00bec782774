"""The MCAP file format: writing, scanning and recovering files."""
