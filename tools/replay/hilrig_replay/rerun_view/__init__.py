"""Visualization of recordings and running rigs in the rerun viewer."""
