"""Matplotlib plots of recordings."""
