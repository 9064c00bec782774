"""HTML reports of recordings."""
