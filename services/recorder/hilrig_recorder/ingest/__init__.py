"""Assigns received messages to sessions: ingest queue, session tracking and pre-roll."""
