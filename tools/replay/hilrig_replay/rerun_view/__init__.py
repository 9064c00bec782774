"""Recordings and running rigs in the rerun viewer."""
